"""The tracker's target as it was printed, measured from pairs of frames of any film."""
