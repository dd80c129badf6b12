"""Light on the skin: outlines of masses, a planned cut and the B-scan's line, drawn by the projector where they are."""
