"""Least squares of unknowns that all views share, each view having a pose of its own: one solver, one covariance."""
