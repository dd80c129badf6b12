"""Faults of data sets and of networks' weights."""

import io
import pickle
import struct
import tarfile
from collections.abc import Iterator
from pathlib import Path

from campaign.byte_faults import cut_faults
from campaign.image_faults import png_faults
from campaign.text_faults import NONSENSE


def tar_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Members that are missing, links, damaged, or nonsense."""
    yield "half", content[: len(content) // 2 + 1000]
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        files = {entry.name: file.read() for entry in archive if (file := archive.extractfile(entry)) is not None}
    truth = next(name for name in files if name.endswith("json"))
    image = next(name for name in files if name.endswith("cam1.png"))
    yield "no members", _tar({})
    yield "a member missing", _tar({name: data for name, data in files.items() if name != image})
    for name, data in png_faults(files[image]):
        if name != "another size":
            yield f"an image of which is {name}", _tar(files | {image: data})
    for name, text in NONSENSE.items():
        yield f"a truth that is {name}", _tar(files | {truth: text.encode()})
        yield f"views that are {name}", _tar(files | {truth: f'{{"views": [{text}, {text}]}}'.encode()})
    yield "a link to a secret", _tar(files, link=image)


def _tar(files: dict[str, bytes], link: str | None = None) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            if name == link:
                entry.type, entry.linkname = tarfile.SYMTYPE, "/etc/passwd"
                archive.addfile(entry)
            else:
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return out.getvalue()


def checkpoint_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """What torch can save but is no network's weights, and code that loading would run."""
    import torch

    class Stealing:
        def __reduce__(self):
            return Path.touch, (Path("stolen"),)

    def saved(value: object) -> bytes:
        file = io.BytesIO()
        torch.save(value, file)
        return file.getvalue()

    yield from cut_faults(content)
    yield "a pickle that runs code", pickle.dumps(Stealing())
    yield "an archive that runs code", saved({"a": Stealing()})
    yield "whole numbers for names", saved({1: torch.zeros(2)})
    yield "words for weights", saved({"conv1.weight": "many"})
    yield "a list", saved([1, 2])
    yield "nothing", saved({})
    state = torch.load(io.BytesIO(content), weights_only=True)
    yield "a weight of another shape", saved(dict(state) | {next(iter(state)): torch.zeros(2)})
    yield "weights that aren't finite", saved({name: value * float("nan") for name, value in state.items()})


def safetensors_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Headers that contradict the file."""
    yield from cut_faults(content)
    yield "a header of 2^62 bytes", struct.pack("<Q", 1 << 62) + content[8:]
    yield "a header that is no JSON", struct.pack("<Q", 4) + b"many" + content[8:]
    yield "other names", content.replace(b".weight", b".height")
