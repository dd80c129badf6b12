"""The simulated instruments, and the comparison of results with their truth."""
