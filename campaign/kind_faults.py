"""Faults of a file by its kind, which its suffix says."""

from collections.abc import Callable, Iterator
from pathlib import Path

from campaign.array_faults import mha_faults, npz_faults, nrrd_faults, ply_faults
from campaign.byte_faults import Content, Fault, cut_faults, replaced
from campaign.image_faults import png_faults
from campaign.learning_faults import checkpoint_faults, safetensors_faults, tar_faults
from campaign.text_faults import json_faults, table_faults, xml_faults, yaml_faults


def faults_of_kind(path: Path) -> Iterator[Fault]:
    """Faults of a valid file that its kind can have, by the file's suffix."""
    content = path.read_bytes()
    kinds: dict[str, Callable[[bytes], Iterator[tuple[str, Content]]]] = {
        ".json": json_faults,
        ".yaml": yaml_faults,
        ".csv": table_faults,
        ".png": png_faults,
        ".npz": npz_faults,
        ".ply": ply_faults,
        ".mha": mha_faults,
        ".nrrd": nrrd_faults,
        ".dcm": cut_faults,
        ".avi": lambda content: iter([("half", content[:2000])]),
        ".tar": tar_faults,
        ".pt": checkpoint_faults,
        ".safetensors": safetensors_faults,
        ".onnx": cut_faults,
        ".xml": xml_faults,
    }
    for name, changed in kinds.get(path.suffix, lambda _: iter(()))(content):
        yield Fault(name, replaced(changed))
