"""The types that every room shares: rig, patterns, boards, calibrations, tracks."""
