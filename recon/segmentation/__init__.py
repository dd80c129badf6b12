"""Masses and tubes in tracked B-scans, as closed surfaces."""
