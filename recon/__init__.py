"""The rig's real software: from images to surfaces, poses, volumes and masses, with no renderer."""
