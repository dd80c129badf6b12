"""Bodies that move and yield: where each of their points is at any moment."""
