"""Steps from a capture to what is found in it, and the store that keeps their results."""
