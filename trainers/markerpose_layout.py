"""MarkerPose's training data: `data_centers.csv` with `images/` for the detector, `patch120/` and `mask120/` for the segmenter.

A row of the table names an image of 320x240 in `images/`, and has the place of each circle in it, px: c0, then that along x (cX),
then that along y (cY). Patch k in the names' order belongs to mask k, white within the outer ellipse. Each image shows all three
circles, and each patch one: their scripts have no other samples.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import decode_image, luma, size_of
from recon.capture.images import image_files, write_images
from recon.capture.meza2021_sweep import check_numbers
from recon.errors import InputError, brief, short
from recon.files import atomic
from recon.files.regular import MOST_TABLE, check_there, opened, read_bytes
from recon.threads import mapped
from trainers.shard_reader import PATCH, VIEW, Patches, Views
from trainers.shard_truth import SEEN, Array
from trainers.stored_images import Grey, StoredImages

TABLE, IMAGES, PATCHES, MASKS = "data_centers.csv", "images", "patch120", "mask120"
COLUMNS = ("FileName", "c0x", "c0y", "cXx", "cXy", "cYx", "cYy")
FRAME = (1280, 1024)  # px, of their cameras; an image is one made smaller
CENTRED = 20.0  # px, most from a patch's middle to that of its disc, so that their turns and shifts leave it in the patch
LEAST_PX = 50  # of a mask
AT_ONCE = 256  # images that are in memory


def recognises(folder: Path) -> bool:
    """Whether a folder has their table or their patches."""
    return (folder / TABLE).exists() or has_patches(folder)


def has_patches(folder: Path) -> bool:
    """Whether a folder has their patches."""
    return (folder / PATCHES).is_dir()


def read_views(folder: Path) -> Views:
    """Read their images, each a sample; damage of images shows when they are decoded.

    Raises
    ------
    InputError
        If the table is missing or damaged, or an image is missing or of another size.
    """
    names, places = read_table(folder / TABLE)
    paths = [folder / IMAGES / name for name in names]
    check_there(paths)
    list(mapped(_check_size, paths, [VIEW] * len(paths)))
    n, scale = len(paths), np.array(FRAME) / VIEW
    centres = (places + 0.5) * scale - 0.5  # where cv2.resize shows what lies in the frame
    return Views(
        _stored(paths, VIEW),
        np.tile(scale, (n, 1)),
        centres,
        np.ones((n, 3)),
        np.ones((n, 3), bool),
        np.full((n, 3), np.nan),
        np.tile(np.arange(3), (n, 1)),
        np.zeros((n, 3), np.int64),
        np.full(n, np.nan),
        np.arange(n),
    )


def read_patches(folder: Path) -> Patches:
    """Read their patches and masks, each pair a sample; the masks are decoded for the ellipses.

    Raises
    ------
    InputError
        If there are none, patches and masks are of different numbers or numbered differently, or one is damaged or of another
        size.
    """
    patches, masks = (image_files(folder / name) for name in (PATCHES, MASKS))
    if not patches or len(patches) != len(masks):
        found = f"{len(patches)} and {len(masks)}"
        raise InputError(f"{folder}: expected as many images in {PATCHES}/ as in {MASKS}/, one or more, found {found}")
    patches, masks = (sorted(paths, key=str) for paths in (patches, masks))  # as their script pairs them
    check_numbers(folder, {PATCHES: patches, MASKS: masks})
    size = (PATCH, PATCH)
    list(mapped(_check_size, patches, [size] * len(patches)))
    n, stored = len(patches), _stored(masks, size)
    ellipses = np.concatenate([_ellipses(stored[k : k + AT_ONCE]) for k in range(0, n, AT_ONCE)])
    return Patches(_stored(patches, size), stored, ellipses, np.ones(n), np.full(n, np.nan), np.arange(n))


def read_table(path: Path) -> tuple[list[str], Array]:
    """Read names of images : n, and places of the circles : (n, 3, 2) px.

    Raises
    ------
    InputError
        If the file is missing or damaged, a place isn't in the image, or a name leads out of the folder.
    """
    try:
        lines = read_bytes(path, MOST_TABLE, expected="MarkerPose's table of centres").decode("utf-8-sig").splitlines()
        rows = [(k, row) for k, row in enumerate(csv.reader(lines), 1) if row]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: expected a table as CSV text, found other or damaged data") from None
    header = [word.strip() for word in rows[0][1]] if rows else []
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(f"{path}: line 1: expected columns {', '.join(missing)}, found {short(','.join(header)) or 'none'}")
    if len(rows) < 2:
        raise InputError(f"{path}: expected one row or more below the header, found none")
    names, places = [], np.empty((len(rows) - 1, 6))
    for place, (k, row) in zip(places, rows[1:], strict=True):
        if len(row) != len(header):
            raise InputError(f"{path}: line {k}: expected {len(header)} columns, found {len(row)}")
        fields = dict(zip(header, row, strict=True))
        name = fields["FileName"].strip()
        if not name or Path(name).is_absolute() or ".." in Path(name).parts or not name.isprintable():
            raise InputError(f"{path}: line {k}: FileName: expected an image within {IMAGES}/, found {brief(name)}")
        names.append(name)
        place[:] = [_place(path, k, column, fields[column]) for column in COLUMNS[1:]]
    return names, places.reshape(-1, 3, 2)


def write_views(folder: Path, views: Views) -> int:
    """Write the views that show all circles of a target of three, and their table; returns their number.

    Raises
    ------
    InputError
        If there is none, or the target has other circles.
    """
    _check_three(views)
    places = (views.centres + 0.5) / views.scale[:, None] - 0.5
    with np.errstate(invalid="ignore"):
        held = ((places >= 0) & (places <= np.array(VIEW) - 1)).all((1, 2)) & (views.visible >= SEEN).all(1)
    chosen = np.flatnonzero(held)
    if not len(chosen):
        raise InputError(f"{IMAGES}: expected views that show all three circles, found none in {len(views)}")
    for first in range(0, len(chosen), AT_ONCE):
        some = chosen[first : first + AT_ONCE]
        write_images([folder / IMAGES / f"im{first + k}.png" for k in range(len(some))], views.images[some])
    with atomic.new_file(folder / TABLE) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows([f"im{k}.png", *row] for k, row in enumerate(places[chosen].reshape(-1, 6).tolist()))
    return len(chosen)


def write_patches(folder: Path, patches: Patches) -> int:
    """Write the patches that show a disc about their middle, and their masks; returns their number. InputError if none does."""
    with np.errstate(invalid="ignore"):
        near = (np.abs(patches.ellipses[:, :2] - (PATCH - 1) / 2) <= CENTRED).all(1) & (patches.visible >= SEEN)
    count = 0
    for some in np.split(np.flatnonzero(near), range(AT_ONCE, near.sum(), AT_ONCE)):
        images, masks = patches.images[some], patches.masks[some]
        large = (masks > 127).sum((1, 2)) >= LEAST_PX
        names = [f"{count + k:06d}.png" for k in range(large.sum())]  # zeros: their script sorts by letter
        for name, stack in ((PATCHES, images), (MASKS, masks)):
            write_images([folder / name / file for file in names], stack[large])
        count += len(names)
    if not count:
        raise InputError(f"{PATCHES}: expected patches with a disc about the middle, found none in {len(patches)}")
    return count


def _check_three(views: Views) -> None:
    if views.body.max() > 0:
        raise InputError(
            "data: expected views of one target each, which MarkerPose's networks are for, found further bodies; "
            "make a set with a rig without bodies"
        )
    if (circles := views.centres.shape[1]) != 3:
        raise InputError(f"data: expected a target of three circles, which MarkerPose's networks are for, found {circles}")


def _place(path: Path, line: int, column: str, word: str) -> float:
    most = VIEW[column.endswith("y")] - 0.5
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not -0.5 <= value < most:
        raise InputError(f"{path}: line {line}: {column}: expected px of an image of 320x240, found {brief(word)}")
    return value


def _stored(paths: Sequence[Path], size: tuple[int, int]) -> StoredImages:
    places = np.array([[k, 0, path.stat().st_size] for k, path in enumerate(paths)], np.int64)
    index = np.column_stack([np.arange(len(paths)), np.zeros(len(paths), np.int64)])
    decode = _view if size == VIEW else _patch
    return StoredImages(tuple(paths), places, (decode,) * len(paths), size, index)


def _view(place: str, content: bytes) -> Grey:
    return _grey(place, content, VIEW)


def _patch(place: str, content: bytes) -> Grey:
    return _grey(place, content, (PATCH, PATCH))


def _grey(place: str, content: bytes, size: tuple[int, int]) -> Grey:
    """An image : (1, h, w), made grey."""
    image = decode_image(Path(place), content)
    if image.dtype != np.uint8 or image.shape[1::-1] != size:
        found = f"{image.shape[1]}x{image.shape[0]} {image.dtype}"
        raise InputError(f"{place}: expected {size[0]}x{size[1]} 8-bit, found {found}")
    return luma(image, 255)[None]


def _check_size(path: Path, size: tuple[int, int]) -> None:
    with opened(path, expected="an image") as stream:
        found = size_of(path, stream)
    if found != size:
        raise InputError(f"{path}: expected {size[0]}x{size[1]} px, found {found[0]}x{found[1]}")


def _ellipses(masks: Grey) -> Array:
    """Ellipses (n, 5) about masks (n, 120, 120), as of `Patches`; NaN without a mask."""
    return np.array([_ellipse(mask) for mask in masks]).reshape(-1, 5)


def _ellipse(mask: NDArray[np.uint8]) -> Sequence[float]:
    contours, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=len, default=np.empty(0))
    least = 5  # points that determine an ellipse
    if len(largest) < least:
        return [np.nan] * 5
    (u, v), (width, height), degrees = cv2.fitEllipse(largest)
    longer, shorter = max(width, height), min(width, height)
    return [u, v, longer / 2, shorter / 2, np.radians(degrees + 90 * (height > width))]
