"""Acceptance of a rig by calibrated artefacts: spheres, a ball bar and a plane, with uncertainty budgets and a decision each.

Terms are those of VDI/VDE 2634 parts 2 and 3 and of ISO 10360-13; uncertainty is by the GUM (JCGM 100, 101), decisions are by ISO
14253-1. It sees what was measured and the artefacts' certificates, and no truth.
"""
