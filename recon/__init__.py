"""The rig's real software: from images to surfaces, poses, volumes and masses, with no renderer."""

import os

# ONNX Runtime reports its use to its maker (Privacy.md in its wheel) unless this is set before it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
