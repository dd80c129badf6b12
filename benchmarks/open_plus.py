"""A volume of each sweep as PLUS compounds it: the tracker's poses as they are, the nearest voxel, the mean of its pixels.

Reads the MetaImage sequence. No lag, no speed of sound, nothing between the voxels that a pixel meets.

python benchmarks/open_plus.py SESSIONS RESULTS
"""

import sys
import zlib
from pathlib import Path

import numpy as np

VOXEL_MM = 0.5


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Images : (n, h, w) and matrices : (n, 4, 4) from their pixels to the world, of frames with a pose."""
    data = path.read_bytes()
    mark = b"ElementDataFile = LOCAL\n"
    end = data.index(mark) + len(mark)
    head = data[:end].decode()
    fields = dict(line.split(" = ", 1) for line in head.splitlines())
    width, height, count = map(int, fields["DimSize"].split())
    images = np.frombuffer(zlib.decompress(data[end:]), np.uint8).reshape(count, height, width)

    good = [k for k in range(count) if fields[f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus"] == "OK"]
    first, second = (
        np.array([np.array(fields[f"Seq_Frame{k:04d}_{name}Transform"].split(), float).reshape(4, 4) for k in good])
        for name in ("ProbeToTracker", "ImageToProbe")
    )
    return images[good], first @ second


def compound(images: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Voxels : (nz, ny, nx) and the place of the first : (3,) mm."""
    height, width = images.shape[1:]
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([u, v, np.zeros_like(u), np.ones_like(u)], axis=-1).reshape(-1, 4)
    corners = np.einsum("nij,kj->nki", matrices, pixels[[0, width - 1, -width, -1]])[..., :3].reshape(-1, 3)
    low = corners.min(0)
    size = np.ceil((corners.max(0) - low) / VOXEL_MM).astype(int) + 1
    total, hits = np.zeros(size.prod()), np.zeros(size.prod())
    for image, matrix in zip(images, matrices, strict=True):
        index = np.rint(((pixels @ matrix.T)[:, :3] - low) / VOXEL_MM).astype(int)
        flat = np.ravel_multi_index(tuple(index.T), size)
        total += np.bincount(flat, image.ravel(), size.prod())
        hits += np.bincount(flat, minlength=size.prod())
    return np.uint8(total / np.maximum(hits, 1)).reshape(size).transpose(2, 1, 0), low


def write(path: Path, voxels: np.ndarray, low: np.ndarray) -> None:
    """Write an uncompressed MetaImage."""
    depth, height, width = voxels.shape
    head = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n"
    head += f"TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = {low[0]} {low[1]} {low[2]}\n"
    head += f"ElementSpacing = {VOXEL_MM} {VOXEL_MM} {VOXEL_MM}\n"
    head += f"DimSize = {width} {height} {depth}\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
    path.write_bytes(head.encode() + np.ascontiguousarray(voxels).tobytes())


if __name__ == "__main__":
    given, results = map(Path, sys.argv[1:3])
    for one in sorted(given.glob("*-ultrasound")):
        (results / one.name).mkdir(parents=True, exist_ok=True)
        write(results / one.name / "volume.mha", *compound(*read(one / "sequence.igs.mha")))
