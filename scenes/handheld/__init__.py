"""The probe with its target, bracket and hand, and the surroundings of tracking frames."""
