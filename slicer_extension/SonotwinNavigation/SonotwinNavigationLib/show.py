"""Show a folder of results in 3D Slicer: `Slicer --python-script show.py`, or paste it into its Python console."""

from pathlib import Path

import slicer

LOOKS = {  # colour and opacity, by the beginning of a model's name
    "skin": ((0.95, 0.88, 0.82), 0.45),
    "table": ((0.60, 0.55, 0.50), 1.0),
    "mass": ((0.78, 0.33, 0.24), 1.0),
    "centre": ((0.24, 0.80, 0.86), 0.6),
    "unseen": ((0.94, 0.71, 0.24), 0.2),
    "path": ((0.24, 0.55, 0.86), 1.0),
    "target_probe": ((0.92, 0.92, 0.92), 1.0),
    "target_circles": ((0.08, 0.08, 0.08), 1.0),
}


def show(folder):
    """Load all that lies in a folder as `sonotwin fuse` writes it for 3D Slicer; returns the nodes by their files' names."""
    nodes = {}
    if (folder / "target_to_world.tfm").exists():
        nodes["target_to_world.tfm"] = slicer.util.loadTransform(str(folder / "target_to_world.tfm"))
    for path in sorted(folder.glob("*.ply")):
        node = nodes[path.name] = slicer.util.loadModel(str(path))
        colour, opacity = next((look for name, look in LOOKS.items() if path.stem.startswith(name)), ((0.35, 0.35, 0.35), 1.0))
        node.GetDisplayNode().SetColor(*colour)
        node.GetDisplayNode().SetOpacity(opacity)
        if "target_to_world.tfm" in nodes and path.stem.startswith("target_"):
            node.SetAndObserveTransformNodeID(nodes["target_to_world.tfm"].GetID())
    for path in sorted(folder.glob("*.nrrd")):
        nodes[path.name] = slicer.util.loadVolume(str(path))
    for path in sorted(folder.glob("*.mrk.json")):
        nodes[path.name] = slicer.util.loadMarkups(str(path))
    return nodes


if __name__ == "__main__":
    show(Path(__file__).resolve().parent)
