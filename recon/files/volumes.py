"""Volumes in space, as `.nrrd` and `.mha` files that 3D Slicer and ITK read.

The files' frame is LPS, as ITK has it. World coordinates are written as they are and declared LPS; 3D Slicer shows RAS, so it
negates x and y, of volumes and of PLY surfaces alike, and what lies together in the world lies together there. A file in RAS or
LAS is turned to LPS when it is read. The same volume has the same bytes whenever it is written.
"""

import bz2
import io
import math
import warnings
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import nrrd
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError, reason
from recon.files import atomic, medical_images
from recon.files.medical_images import fault
from recon.files.regular import read_bytes

Array = NDArray[np.float64]

MOST_BYTES = 1 << 33  # of all voxels, and of a file of them
META_NAMES = {np.dtype(code): name for name, code in medical_images.META_TYPES.items()}
NRRD_NAMES = {dtype: {"f4": "float", "f8": "double"}.get(dtype.str[1:], dtype.name) for dtype in META_NAMES}
DAMAGE = (  # what pynrrd raises on headers and pixels damaged at random: it parses without checking
    *(nrrd.NRRDError, ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, MemoryError, EOFError),
    *(ZeroDivisionError, StopIteration, zlib.error),
)
LPS_FROM = {  # signs of x, y, z
    "left-posterior-superior": (1, 1, 1),
    "lps": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "ras": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
    "las": (1, -1, 1),
    "scanner-xyz": (1, 1, 1),  # no anatomy is meant
    "3d-right-handed": (1, 1, 1),
}


@dataclass(frozen=True)
class Volume:
    """Voxels on a grid in space.

    Voxel (i, j, k) is `voxels[k, j, i]`, and its centre lies at `origin + directions @ (spacing * (i, j, k))`.
    """

    voxels: NDArray  # (nz, ny, nx)
    origin: Array  # (3,) mm, the centre of voxel (0, 0, 0)
    spacing: Array  # (3,) mm along x, y, z
    directions: Array = field(default_factory=lambda: np.eye(3))  # (3, 3), columns: the unit vectors of the voxels' axes

    @property
    def world_from_voxel(self) -> Array:
        """The matrix (4, 4) that takes indices (i, j, k) to mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.directions * self.spacing
        matrix[:3, 3] = self.origin
        return matrix


def read_volume(path: Path) -> Volume:
    """Read a volume from `.nrrd`, `.nhdr`, `.mha` or `.mhd`.

    Raises
    ------
    InputError
        If the file is missing, cut short, damaged, of another kind or no volume of one number a voxel.
    """
    path = Path(path)
    return _read_nrrd(path) if path.suffix in (".nrrd", ".nhdr") else _read_metaimage(path)


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume as `.nrrd` or `.mha`, by the path's suffix, packed; reading it gives the same numbers, to the last bit.

    Raises
    ------
    InputError
        If the suffix or the type of the voxels is another, or the grid is none.
    """
    path = Path(path)
    if path.suffix not in (".nrrd", ".mha"):
        raise InputError(f"{path}: expected a name that ends in .nrrd or .mha, found {path.name}")
    voxels = volume.voxels.astype(np.uint8) if volume.voxels.dtype == bool else volume.voxels
    if voxels.ndim != 3 or 0 in voxels.shape or voxels.dtype.newbyteorder("<") not in META_NAMES:
        raise fault(path, "voxels", "z x y x x numbers of 8, 16 or 32 bits or float64", f"{voxels.shape} of {voxels.dtype}")
    _check_grid(path, volume)
    voxels = np.ascontiguousarray(voxels, voxels.dtype.newbyteorder("<"))
    with atomic.new_file(path) as temporary:
        if path.suffix == ".mha":
            _write_metaimage(temporary, voxels, volume)
        else:
            _write_nrrd(temporary, voxels, volume)


def _read_nrrd(path: Path) -> Volume:
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            voxels, header = _nrrd_content(path)
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{path}: expected an NRRD volume, found it damaged: {reason(error)}") from None
    if voxels.ndim != 3:
        raise fault(path, "dimension", "3 axes of one number a voxel", header["dimension"])
    space = str(header.get("space", "scanner-xyz")).lower()
    if space not in LPS_FROM:
        raise fault(path, "space", f"one of {', '.join(LPS_FROM)}", space)
    signs = np.array(LPS_FROM[space], float)
    axes = np.asarray(header.get("space directions", np.diag(header.get("spacings", np.ones(3)))), float)  # a row an axis
    origin = np.asarray(header.get("space origin", np.zeros(3)), float)
    if axes.shape != (3, 3) or origin.shape != (3,):
        raise fault(path, "space directions", "3 vectors of 3 numbers", axes.shape)
    spacing = np.linalg.norm(axes, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        volume = Volume(voxels, signs * origin, spacing, signs[:, None] * (axes / spacing[:, None]).T)
    _check_grid(path, volume)
    return volume


def _nrrd_content(path: Path) -> tuple[NDArray, nrrd.NRRDHeader]:
    """Voxels and header by pynrrd, which is given no more bytes than the header has voxels."""
    stream = io.BytesIO(read_bytes(path, MOST_BYTES))
    header = nrrd.read_header(stream)
    detached = header.pop("data file", header.pop("datafile", None))
    if detached is not None:
        medical_images.check_beside(path, path.parent / detached)
        stream = io.BytesIO(read_bytes(path.parent / detached, MOST_BYTES))
    largest_voxel = 8  # bytes
    most = largest_voxel * math.prod(map(int, header["sizes"])) + 1
    if not 1 < most <= MOST_BYTES:
        raise fault(path, "sizes", f"numbers of voxels, up to {MOST_BYTES // largest_voxel} in all", header["sizes"])
    lines = header.pop("line skip", header.pop("lineskip", 0))
    for _ in range(lines):
        if not stream.readline():
            raise fault(path, "line skip", "a number of lines that are there", lines)
    unpacker = {"gz": lambda: zlib.decompressobj(31), "gzip": lambda: zlib.decompressobj(31), "bz2": bz2.BZ2Decompressor}
    packing = header["encoding"].replace("bzip2", "bz2")
    if packing in unpacker:
        most += max(header.get("byte skip", header.get("byteskip", 0)), 0)
        stream = io.BytesIO(unpacker[packing]().decompress(stream.read(), min(most, MOST_BYTES)))
        header["encoding"] = "raw"
    voxels = nrrd.read_data(header, stream, index_order="C")
    if stream.read(1):
        raise fault(path, "sizes", "numbers of all voxels", f"{header['sizes']}, and more data")
    return voxels, header


def _read_metaimage(path: Path) -> Volume:
    file = medical_images.read_header(path)
    if len(file.size) != 3 or 0 in file.size:
        raise file.fault("DimSize", "3 numbers of voxels", " ".join(map(str, file.size)))
    if file.channels != 1:
        raise file.fault("ElementNumberOfChannels", 1, file.channels)
    if file.pixel.itemsize == 0:
        raise file.fault("ElementType", f"one of {', '.join(medical_images.META_TYPES)}", file.fields["ElementType"])
    if file.data_bytes > MOST_BYTES:
        raise file.fault("DimSize", f"voxels of up to {MOST_BYTES >> 30} GiB", " ".join(map(str, file.size)))
    (data,) = medical_images.blocks(file, file.data_bytes)
    fields = file.fields
    origin = fields.get("Offset", fields.get("Position", fields.get("Origin", "0 0 0")))
    matrix = fields.get("TransformMatrix", fields.get("Rotation", fields.get("Orientation", "1 0 0 0 1 0 0 0 1")))
    spacing = medical_images.numbers(path, "ElementSpacing", fields.get("ElementSpacing", "1 1 1"), 3)
    volume = Volume(
        np.frombuffer(data, file.pixel).reshape(file.size[::-1]),
        medical_images.numbers(path, "Offset", origin, 3),
        spacing,
        medical_images.numbers(path, "TransformMatrix", matrix, 9).reshape(3, 3).T,  # a direction a row
    )
    _check_grid(path, volume)
    return volume


def _check_grid(path: Path, volume: Volume) -> None:
    farthest_mm = 1e9
    if np.shape(volume.origin) != (3,) or not (np.abs(volume.origin) < farthest_mm).all():
        raise fault(path, "origin", "3 finite numbers", f"{volume.origin}, beyond {farthest_mm:g} mm or none")
    if np.shape(volume.spacing) != (3,) or not ((volume.spacing > 0) & (volume.spacing < farthest_mm)).all():
        raise fault(path, "spacing", "3 lengths above 0", f"{volume.spacing}, beyond {farthest_mm:g} mm or none")
    if np.shape(volume.directions) != (3, 3) or not (np.abs(volume.directions) < 2).all():
        raise fault(path, "directions", "3 unit vectors", np.ravel(volume.directions))
    if abs(abs(np.linalg.det(volume.directions)) - 1) > 1e-3:
        raise fault(path, "directions", "3 unit vectors at right angles", np.ravel(volume.directions))


def _write_metaimage(path: Path, voxels: NDArray, volume: Volume) -> None:
    packed = medical_images.pack(voxels, gzip=False)
    nz, ny, nx = voxels.shape
    fields = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "True",
        "CompressedDataSize": len(packed),
        "TransformMatrix": _words(volume.directions.T),
        "Offset": _words(volume.origin),
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",  # what ITK calls LPS, by where the axes come from
        "ElementSpacing": _words(volume.spacing),
        "DimSize": f"{nx} {ny} {nz}",
        "ElementType": META_NAMES[voxels.dtype],
        "ElementDataFile": "LOCAL",
    }
    path.write_bytes("".join(f"{name} = {value}\n" for name, value in fields.items()).encode("ascii") + packed)


def _write_nrrd(path: Path, voxels: NDArray, volume: Volume) -> None:
    """As pynrrd would, but for its line with the date, by which the same volume would have other bytes a second later."""
    axes = (volume.directions * volume.spacing).T
    nz, ny, nx = voxels.shape
    fields = {
        "type": NRRD_NAMES[voxels.dtype],
        "dimension": 3,
        "space": "left-posterior-superior",
        "sizes": f"{nx} {ny} {nz}",
        "space directions": " ".join(map(_vector, axes)),
        "kinds": "domain domain domain",
        "endian": "little",
        "encoding": "gzip",
        "space origin": _vector(volume.origin),
    }
    head = "".join(f"{name}: {value}\n" for name, value in fields.items())
    path.write_bytes(f"NRRD0004\n{head}\n".encode("ascii") + medical_images.pack(voxels, gzip=True))


def _vector(values: Array) -> str:
    return f"({','.join(_words(values).split())})"


def _words(values: Array) -> str:
    return " ".join(repr(value) for value in np.ravel(np.asarray(values, float)).tolist())
