"""The rig's parameters from its own captures: sensors, lenses, projector and scanner, each with its uncertainty."""
