"""The fit of a ring's outer rim to the pixels beside it, compiled."""
