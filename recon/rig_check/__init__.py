"""Is the rig still as it was calibrated: its devices against each other, the probe on its bracket, and the scanner's clock."""
