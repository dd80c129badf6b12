"""Tracked ultrasound as sequence files of the PLUS toolkit and 3D Slicer, `.igs.mha` and `.igs.nrrd`: B-scans with their poses.

A transform `AToB` takes points of frame A to frame B. The frame `Image` is in pixels: (u, v, 0) is the centre of pixel (u, v).
`RAS` is 3D Slicer's frame, `LPS` that of its files of volumes and meshes, half a turn from it.

3D Slicer makes a node of each transform of a sequence and puts none under another; what stands at the top is taken as RAS. Only
the images have a place of their own: by the transform `TToPhysical`, where T is the file's field `TrackName`.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator

from recon import registry
from recon.errors import InputError
from recon.files import atomic, medical_images
from recon.model.probe import ProbeCalibration

Array = NDArray[np.float64]


def _named(name: str) -> str:
    if not re.fullmatch(r"[A-Z]\w*", name):
        raise ValueError(f"expected a frame as in the sequence's transforms, AToB, with a capital letter first, found {name}")
    return name


FrameName = Annotated[str, AfterValidator(_named)]  # of a frame of reference; of a setting

FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(.+)")
TRANSFORM = re.compile(r"([A-Z]\w*?)To([A-Z]\w*)")
STRUCTURE = {  # fields given by the images and the format, in either of the two
    *("ObjectType", "NDims", "DimSize", "Kinds", "ElementType", "ElementNumberOfChannels", "ElementSpacing", "Offset"),
    *("TransformMatrix", "CenterOfRotation", "AnatomicalOrientation", "BinaryData", "BinaryDataByteOrderMSB", "CompressedData"),
    *("CompressedDataSize", "ElementDataFile", "ElementByteOrderMSB", "UltrasoundImageOrientation", "UltrasoundImageType"),
    *(
        "type",
        "dimension",
        "sizes",
        "kinds",
        "encoding",
        "endian",
        "space",
        "space dimension",
        "space directions",
        "space origin",
    ),
    *("data file", "datafile", "ultrasound image orientation", "ultrasound image type"),
}
FARTHEST_MM, MOST_SECONDS = 1e7, 9e9  # of a matrix; of a time stamp, that nanoseconds of 64 bits can hold
FRAME_STRUCTURE = {"Timestamp", "ImageStatus", "Status", ""}
DIALECTS = "recon.freehand.sequence_dialects"  # a module each
RAS, LPS = "RAS", "LPS"
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])  # and LPS from RAS
SHOWN = "Physical"  # where 3D Slicer shows the images, its RAS


class FrameNames(NamedTuple):
    """Names of a sequence's frames of reference."""

    image: str = "Image"  # of pixels
    target: str = "Probe"  # of what the probe carries
    reference: str = "Reference"  # of what the results are in, the world


@dataclass(frozen=True)
class Frames:
    """A tracked sequence of n frames."""

    times_s: Array  # (n,), NaN where a frame has none
    transforms: dict[str, Array]  # "ProbeToTracker": tracker_from_probe (n, 4, 4), mm; the identity in frames that have none
    valid: dict[str, NDArray[np.bool_]]  # (n,) by the transforms' names; and by "Image", if there are images
    images: NDArray[np.uint8] | None = None  # (n, h, w), the array's marked side right and depth down; None if tracking only
    frame_fields: dict[str, tuple[str, ...]] = field(default_factory=dict)  # n texts; empty where a frame has none
    fields: dict[str, str] = field(default_factory=dict)  # of the whole file


def sequence_of(images: ArrayLike, world_from_target: Array, probe: ProbeCalibration, times_s: ArrayLike) -> Frames:
    """Make a PLUS sequence of one's own B-scans and poses.

    Its frames are `Image`, `Probe` (the target), `Tracker` and `Reference` (both are the world), so that the reconstruction in
    PLUS or 3D Slicer finds `ImageToReference` without further settings. Files of volumes, meshes and markups in the world are
    declared LPS, so that 3D Slicer turns them: `ReferenceToRAS` is the same half turn, and by `ImageToPhysical` 3D Slicer shows
    each B-scan where they lie.

    Parameters
    ----------
    images : (n, h, w) uint8
    world_from_target : (n, 4, 4) mm
        Poses; those with a NaN count as not found.
    probe : ProbeCalibration
    times_s : (n,) s

    Raises
    ------
    InputError
        If the numbers of images, poses and times differ, or images are no grey bytes.
    """
    images, poses, times = np.asarray(images), np.asarray(world_from_target, float), np.asarray(times_s, float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"world_from_target: expected n poses of 4 x 4, found {poses.shape}")
    found = np.isfinite(poses).all(axis=(1, 2))
    always = np.ones(len(poses), bool)
    shown = RAS_FROM_LPS @ poses @ target_from_pixel(probe)
    transforms = {
        "ImageToProbe": np.tile(target_from_pixel(probe), (len(poses), 1, 1)),
        "ProbeToTracker": np.where(found[:, None, None], poses, np.eye(4)),
        "ReferenceToTracker": np.tile(np.eye(4), (len(poses), 1, 1)),
        f"ReferenceTo{RAS}": np.tile(RAS_FROM_LPS, (len(poses), 1, 1)),
        f"ImageTo{SHOWN}": np.where(found[:, None, None], shown, np.eye(4)),
    }
    valid = dict.fromkeys([*transforms, "Image"], always) | {"ProbeToTracker": found, f"ImageTo{SHOWN}": found}
    track_name = "TrackName"  # field of the file that names the frame of the images shown there
    frames = Frames(times, transforms, valid, images, fields={track_name: "Image"})
    _check(Path("sequence"), frames)
    return frames


def target_from_pixel(probe: ProbeCalibration) -> Array:
    """The matrix (4, 4) that takes pixels [u, v, 0, 1] to the target's frame in mm; ImageToProbe in PLUS."""
    return probe.target_from_image @ np.diag([*probe.scale, np.mean(probe.scale), 1.0])


def poses(frames: Frames, to: str, of: str, fixed: Mapping[str, Array] | None = None) -> Array:
    """Transforms (n, 4, 4) that take points of frame `of` to frame `to`, along a chain of transforms; NaN where invalid.

    Where a transform leads to RAS, by whatever case of letters, its half turn leads on to LPS.

    Parameters
    ----------
    fixed : (4, 4) by name, optional
        Transforms that do not change, such as "ImageToProbe" of a calibration; they go before those of the file.

    Raises
    ------
    InputError
        If no chain of transforms leads from one to the other.
    """
    result = np.broadcast_to(np.eye(4), (len(frames.times_s), 4, 4))
    for name in chain(frames.transforms, to, of, fixed):
        if fixed and name in fixed:
            forth = fixed[name]
        else:
            forth = _usable(frames, name) if name in frames.transforms else RAS_FROM_LPS
        source, destination = TRANSFORM.findall(name)[0]
        result, of = (forth @ result, destination) if source == of else (np.linalg.inv(forth) @ result, source)
    return result


def chain(transforms: Collection[str], to: str, of: str, fixed: Collection[str] | None = None) -> list[str]:
    """Names of those transforms that lead from frame `of` to frame `to`, as of `poses`; RASToLPS for the half turn among them.

    Raises
    ------
    InputError
        If none lead there.
    """
    names = list(dict.fromkeys([*(fixed or ()), *transforms]))
    ends = {name: match.groups() for name in names if (match := TRANSFORM.fullmatch(name))}
    turns = {frame for pair in ends.values() for frame in pair if frame.upper() == RAS}
    ends |= {name: (frame, LPS) for frame in sorted(turns) if (name := f"{frame}To{LPS}") not in ends}
    chains: dict[str, list[str]] = {of: []}
    for here in (waiting := [of]):
        for name, pair in ends.items():
            if here in pair and (there := pair[pair[0] == here]) not in chains:
                chains[there] = [*chains[here], name]
                waiting.append(there)
    if to not in chains and not transforms:
        expected = "some in each frame, such as ProbeToTracker, of the tracker"
        raise InputError(f"transforms: expected {expected}, found none: without poses nothing says where an image was taken")
    if to not in chains:
        leads = f", which lead from there to {', '.join(list(chains)[1:])}" if len(chains) > 1 else ""
        raise InputError(f"transforms: expected some that lead from {of} to {to}, found {', '.join(names) or 'none'}{leads}")
    return chains[to]


def lies_elsewhere(frames: Frames, reference: str) -> bool:
    """Whether the file's transforms to RAS put a frame elsewhere than files that are declared LPS; False if it has none."""
    try:
        lps_from_reference = poses(frames, LPS, reference)
    except InputError:
        return False
    placed = lps_from_reference[np.isfinite(lps_from_reference).all(axis=(1, 2))]
    same = 1e-6  # of the entries of matrices
    return bool(np.abs(placed - np.eye(4)).max(initial=0) > same)


def dialect_of(path: Path) -> Any:
    """The module of `sequence_dialects` that recognises a file, else that of PLUS; InputError if several do."""
    known = {name: dialect for name, dialect in registry.kinds(DIALECTS).items() if dialect.recognises(path)}
    if len(known) > 1:
        raise InputError(f"{path}: expected a sequence of one dialect, found {' and '.join(known)}")
    return next(iter(known.values()), registry.kind(DIALECTS, "plus_sequence"))


def read_sequence(path: Path) -> Frames:
    """Read a whole sequence with its images.

    Raises
    ------
    InputError
        If the file is damaged or cut short, of another kind, or a field is wrong; the message names it.
    """
    frames, shape = read_tracking(path), dialect_of(path).image_shape(path)
    if shape is None:
        return frames
    images = np.empty((len(frames.times_s), *shape), np.uint8)
    for image, read in zip(images, stream_images(path), strict=True):
        image[:] = read
    return replace(frames, images=images)


def read_tracking(path: Path) -> Frames:
    """Read a sequence without its images, which `stream_images` gives one by one: for sequences larger than memory."""
    return dialect_of(path).read_tracking(path)


def image_shape(path: Path) -> tuple[int, int]:
    """Height and width of a sequence's images. Raises InputError if it has none."""
    shape = dialect_of(path).image_shape(path)
    if shape is None:
        raise medical_images.fault(path, "DimSize", "images", "tracking only")
    return shape


def stream_images(path: Path) -> Iterator[NDArray[np.uint8]]:
    """The images (h, w) of a sequence one by one; none if it is tracking only. Raises InputError where the data ends early."""
    return dialect_of(path).images(path)


def write_sequence(path: Path, frames: Frames) -> None:
    """Write a sequence as `.mha` or `.nrrd`, by the path's suffix, packed. It reads back the same to the last bit.

    Raises
    ------
    InputError
        If the suffix is another, a number is not finite, a shape does not fit or a text would break the header. Nothing is
        written then.
    """
    path = Path(path)
    if path.suffix not in (".mha", ".nrrd"):
        raise InputError(f"{path}: expected a name that ends in .igs.mha or .igs.nrrd, found {path.name}")
    _check(path, frames)
    images = frames.images if frames.images is not None else np.zeros((len(frames.times_s), 1, 1), np.uint8)
    head = _meta_head if path.suffix == ".mha" else _nrrd_head
    sign, status = (" = ", "ImageStatus") if path.suffix == ".mha" else (":=", "Status")
    lines = _frame_lines(frames, sign, status)
    with atomic.new_file(path) as temporary, temporary.open("wb") as stream:
        packed = medical_images.pack(images, gzip=path.suffix == ".nrrd")
        start, end = head(images.shape, len(packed), frames)
        stream.write("".join(f"{line}\n" for line in (*start, *lines, *end)).encode("utf-8", "surrogateescape"))
        stream.write(packed)


def is_usable(matrix: Array) -> bool:
    """Whether a matrix (4, 4) is an invertible affine transform."""
    upright = np.abs(matrix[3] - (0, 0, 0, 1)).max() < 1e-6 and np.abs(matrix).max() < FARTHEST_MM
    return bool(upright and np.linalg.cond(matrix[:3, :3]) < 1e6)


def _usable(frames: Frames, name: str) -> Array:
    return np.where(frames.valid[name][:, None, None], frames.transforms[name], np.nan)


def _check(path: Path, frames: Frames) -> None:
    """Refuse frames that would not be read back the same."""
    count = len(frames.times_s)
    if count == 0:
        raise medical_images.fault(path, "frames", "at least one", "none")
    if (endless := np.isinf(frames.times_s)).any():
        raise medical_images.fault(
            path, frame_key(int(endless.argmax()), "Timestamp"), "a finite number or NaN", "an infinite one"
        )
    images = frames.images
    if images is not None and (images.ndim != 3 or images.dtype != np.uint8 or len(images) != count or 0 in images.shape):
        raise medical_images.fault(path, "images", f"{count} x height x width of uint8", f"{images.shape} of {images.dtype}")
    for name, matrices in frames.transforms.items():
        if matrices.shape != (count, 4, 4) or frames.valid.get(name, np.empty(0)).shape != (count,):
            raise medical_images.fault(path, name, f"{count} transforms of 4 x 4, valid or not", matrices.shape)
        for index, matrix in enumerate(matrices):
            if not np.isfinite(matrix).all() or (frames.valid[name][index] and not is_usable(matrix)):
                found = repr(" ".join(f"{value:g}" for value in matrix.ravel()))
                raise medical_images.fault(
                    path, frame_key(index, name + "Transform"), "an invertible matrix of finite numbers", found
                )
    for name in [name for name in frames.transforms if not TRANSFORM.fullmatch(name)]:
        raise medical_images.fault(path, "transforms", "names such as ProbeToTracker", repr(name))
    for name, texts in frames.frame_fields.items():
        if len(texts) != count:
            raise medical_images.fault(path, name, f"{count} texts", len(texts))
    for name in [*frames.fields, *frames.frame_fields]:
        if (
            name in STRUCTURE | FRAME_STRUCTURE
            or name.endswith("Transform")
            or FRAME_FIELD.fullmatch(name)
            or name != name.strip()
        ):
            raise medical_images.fault(path, "fields", "names that the format does not use itself", repr(name))
    for name, text in [*frames.fields.items(), *((n, t) for n, texts in frames.frame_fields.items() for t in texts)]:
        if re.search(r"[\r\n]", name + text) or re.search(r"[:=#]", name) or text != text.strip():
            raise medical_images.fault(path, name, "a text of one line", repr(text))


def frame_key(index: int, name: str) -> str:
    """Name of a frame's field in a file."""
    return f"Seq_Frame{index:04d}_{name}"


def _frame_lines(frames: Frames, sign: str, image_status: str) -> Iterator[str]:
    for index, time in enumerate(frames.times_s):
        texts = {name: texts[index] for name, texts in frames.frame_fields.items() if texts[index]}
        for name, matrices in frames.transforms.items():
            key, valid = name + "Transform", frames.valid[name][index]
            texts[key] = " ".join(repr(value) for value in matrices[index].ravel().tolist())
            word = texts.get(key + "Status", "INVALID")
            texts[key + "Status"] = "OK" if valid else word if word.upper() != "OK" else "INVALID"
        if np.isfinite(time):
            texts["Timestamp"] = repr(float(time))
        if frames.images is not None:
            texts[image_status] = "OK" if "Image" not in frames.valid or frames.valid["Image"][index] else "INVALID"
        yield from (f"{frame_key(index, name)}{sign}{text}" for name, text in texts.items())


def _meta_head(shape: tuple[int, ...], packed: int, frames: Frames) -> tuple[list[str], list[str]]:
    count, height, width = shape
    start = {
        "ObjectType": "Image",
        "NDims": "3",
        "AnatomicalOrientation": "RAI",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CenterOfRotation": "0 0 0",
        "CompressedData": "True",
        "CompressedDataSize": str(packed),
        "DimSize": f"{width} {height} {count}",
        "ElementNumberOfChannels": "1",
        "ElementSpacing": "1 1 1",
        "ElementType": "MET_UCHAR",
        "Kinds": "domain domain list",
        "Offset": "0 0 0",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "UltrasoundImageOrientation": "MF",
        "UltrasoundImageType": "BRIGHTNESS",
    }
    return [f"{name} = {value}" for name, value in (start | frames.fields).items()], ["ElementDataFile = LOCAL"]


def _nrrd_head(shape: tuple[int, ...], packed: int, frames: Frames) -> tuple[list[str], list[str]]:
    count, height, width = shape
    start = ["NRRD0004", "type: unsigned char", "dimension: 3", "space dimension: 2", f"sizes: {width} {height} {count}"]
    start += ["space directions: (1,0) (0,1) none", "kinds: domain domain list", "endian: little", "encoding: gz"]
    start += ["space origin: (0,0)", "ultrasound image orientation:=MF", "ultrasound image type:=BRIGHTNESS"]
    return start + [f"{name}:={value}" for name, value in frames.fields.items()], [""]
