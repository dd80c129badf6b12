"""Virtual devices and a virtual hand: the rig that a recording is tried on."""
