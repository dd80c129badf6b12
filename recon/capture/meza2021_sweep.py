"""A folder of frames as the rig authors' public programs record and read it, and the files of the probe's calibration.

Frame k of `L`, `R` (cameras 1 and 2), `US` or `UScrop` (the scanner) and `USmasks` belongs together, taken at one moment; there
are no time stamps. `target_pose.npy` holds `world_from_target` of each frame, `cross_point.npy` the pixel of the wires' crossing.
"""

import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture.images import image_files, read_grey, write_images
from recon.errors import InputError
from recon.files import npz
from recon.geometry import rigid

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

FOLDER = "USdata"
POSES, CROSSINGS = "target_pose.npy", "cross_point.npy"
FOLDERS = {"cam1": "L", "cam2": "R", "us": "US"}  # of each device's images
CROPPED = "UScrop"  # of B-scans that were cut out of the scanner's screen
NAMES = {device: f"{name}/{{}}.png" for device, name in FOLDERS.items()}  # by the frame's number
MASKS = ("USmasks", "masks")  # folders of masks; the second in some versions of their program
LOOSE = 0.04  # of a rotation's products: triangulated axes are off by up to 2 %


@dataclass(frozen=True)
class AuthorsSweep:
    """n frames of their layout; images are listed and not read yet."""

    folders: dict[str, str]  # device: name of its folder, of those that are there
    images: dict[str, list[Path]]  # device: n paths
    sizes: dict[str, tuple[int, int]]  # width, height, px
    masks: list[Path]
    poses: Array | None  # (n, 4, 4) world_from_target, mm
    crossings: Array | None  # (n, 2) px

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(next(iter(self.images.values())))


def read_sweep(place: Path, scanner: Sequence[str] = (FOLDERS["us"],)) -> AuthorsSweep | None:
    """Read a folder of frames; None if it holds none.

    Rotations that are off by up to 2 % are made orthonormal, with a warning.

    Parameters
    ----------
    scanner : names that the folder of B-scans may have; the first that is there counts

    Raises
    ------
    InputError
        If folders, poses or crossings are of different numbers of frames, their files are numbered differently, one is damaged,
        or a pose is none.
    """
    names = {device: (name,) for device, name in FOLDERS.items()} | {"us": tuple(scanner)}
    listed = {device: {name: image_files(place / name) for name in each} for device, each in names.items()}
    folders = {device: next((name for name, paths in each.items() if paths), None) for device, each in listed.items()}
    folders = {device: name for device, name in folders.items() if name is not None}
    images = {device: listed[device][name] for device, name in folders.items()}
    if not images:
        return None
    first, count = next((folders[device], len(paths)) for device, paths in images.items())
    masks = next((found for name in MASKS if (found := image_files(place / name))), [])
    counts = {f"{folders[device]}/": len(paths) for device, paths in images.items()}
    counts |= {f"{MASKS[0]}/": len(masks)} if masks else {}
    poses, crossings = read_rows(place / POSES, (4, 4)), read_rows(place / CROSSINGS, (2,))
    counts |= {name: len(rows) for name, rows in ((POSES, poses), (CROSSINGS, crossings)) if rows is not None}
    for name, found in counts.items():
        if found != count:
            raise InputError(f"{place / name}: expected {count} frames, as in {first}/, found {found}")
    check_numbers(place, {folders[device]: paths for device, paths in images.items()})
    sizes = {device: read_grey(paths[0]).shape[::-1] for device, paths in images.items()}
    return AuthorsSweep(folders, images, sizes, masks, None if poses is None else _rigid(place / POSES, poses), crossings)


def check_numbers(place: Path, folders: Mapping[str, Sequence[Path]]) -> None:
    """Refuse folders with equally many images that lack different ones, by the last number in the files' names.

    Warns of folders whose first numbers differ: counted from elsewhere, or without the first ones.
    """
    found = {name: [re.findall(r"\d+", path.stem) for path in paths] for name, paths in folders.items()}
    if not all(each for numbers in found.values() for each in numbers):
        return
    (first, numbers), *others = ((name, [int(each[-1]) for each in numbers]) for name, numbers in found.items())
    for name, those in others:
        steps = [(one - numbers[0], other - those[0]) for one, other in zip(numbers, those, strict=True)]
        if k := next((k for k, (one, other) in enumerate(steps) if one != other), 0):
            one, other = folders[first][k].name, folders[name][k].name
            raise InputError(f"{place / name}: expected the frame of {first}/{one} next, found {other}: is one lost in between?")
        if numbers[0] != those[0]:
            one, other = folders[first][0].name, folders[name][0].name
            log.warning(
                "%s: begins with %s, and is taken to belong to %s/%s: are the first ones lost?", place / name, other, first, one
            )


def write_sweep(
    place: Path,
    images: Iterable[tuple[str, int, Grey]],
    masks: Iterable[Grey],
    poses: Array,
    crossings: Array | None = None,
    names: Mapping[str, str] = NAMES,
) -> None:
    """Write a folder of frames.

    Parameters
    ----------
    images : of (device, number of the frame, (h, w))
        Taken one by one.
    masks : n of (h, w)
        What is shown in space; empty for none.
    poses : (n, 4, 4) mm
    crossings : (n, 2) px; None where they are still to be found
    names : device -> file within the folder, by the frame's number
    """
    for device, number, image in images:
        write_images([place / names[device].format(number)], image[None])
    for number, mask in enumerate(masks):
        write_images([place / MASKS[0] / f"{number}.png"], mask[None])
    place.mkdir(exist_ok=True)
    np.save(place / POSES, poses)
    if crossings is not None:
        np.save(place / CROSSINGS, crossings)


def mended(place: str, pose: Array) -> Array:
    """A pose : (4, 4) whose rotation is off by up to 2 %, made rigid with a warning.

    Parameters
    ----------
    place : file and field, for messages

    Raises
    ------
    InputError
        If it is none even so.
    """
    if found := rigid.fault(pose, LOOSE):
        raise InputError(f"{place}: expected {rigid.RIGID}, in mm, found {found}")
    if rigid.fault(pose):
        off = 100 * np.abs(np.linalg.svd(pose[:3, :3], compute_uv=False) - 1).max()
        log.warning("%s: axes are up to %.2g %% off a rotation, and are taken as the nearest one", place, off)
        return rigid.nearest(pose)
    return pose


def _rigid(path: Path, poses: Array) -> Array:
    """All poses as rigid transforms, with one warning for all."""
    for k, pose in enumerate(poses):
        if found := rigid.fault(pose, LOOSE):
            raise InputError(f"{path}: frame {k}: expected {rigid.RIGID}, in mm, found {found}")
    loose = [k for k, pose in enumerate(poses) if rigid.fault(pose)]
    if loose:
        log.warning("%s: axes of %d poses are up to 2 %% off a rotation, and are taken as the nearest one", path, len(loose))
    return np.stack([rigid.nearest(pose) for pose in poses])


def read_rows(path: Path, shape: tuple[int, ...]) -> Array | None:
    """Read numbers : (n, *shape) of an npy file; None without one, InputError if it is damaged or of another shape."""
    if not os.path.lexists(path):
        return None
    rows = npz.read_npy(path)
    if rows.ndim != 1 + len(shape) or rows.shape[1:] != shape or rows.dtype.kind not in "fiu":
        expected = f"numbers of shape (n, {', '.join(map(str, shape))})"
        raise InputError(f"{path}: expected {expected}, found {rows.dtype} of shape {rows.shape}")
    finite = np.isfinite(rows).all(axis=tuple(range(1, rows.ndim)))
    if not finite.all():
        raise InputError(f"{path}: frame {int(np.argmin(finite))}: expected finite numbers, found some that aren't")
    return rows.astype(float)
