"""Least squares of unknowns that all views share, each view having a pose of its own.

One descent with damped steps, equations in rows or added up with poses eliminated, and one propagation of covariance.
"""
