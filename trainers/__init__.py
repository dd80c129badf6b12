"""Training and evaluation of the tracker's two networks."""
