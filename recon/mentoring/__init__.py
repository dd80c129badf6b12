"""A colleague elsewhere draws on camera 1's picture, and the projector lights it on the skin, which may move."""
