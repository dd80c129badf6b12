"""Cameras, projector, scanner and poses of others as the rig's devices, with their clocks."""
