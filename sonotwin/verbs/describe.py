"""Write the manifest of images that were recorded elsewhere: a board's poses, or a surface under fringes.

Reads a folder of images, of which camera, pose and number stand in the names of folders or files, such as cam1/pose03/07.png,
left_01.png and right_01.png, or P1_00.bmp; other names are given by `files`. Sizes and depths come from the images, the
projector's size from the patterns. Refuses names of two meanings, and numbers of images that differ from that of the patterns;
says which cameras' images are colour or JPEG, by which no noise can be measured.
Writes the capture folder `out`, with a manifest that points at the images, which stay where they are; a capture that is there
already is replaced. Takes seconds.

    sonotwin describe folder=images board='{kind: chessboard, columns: 9, rows: 6, square_mm: 25}' out=capture
    sonotwin describe folder=poses patterns=gray_alone board='{kind: chessboard, columns: 9, rows: 6, square_mm: 25}' out=capture
    sonotwin describe folder=shots patterns=paper_surface calibration=optics.yaml out=capture
    sonotwin describe folder=shots patterns=sequence.yaml files='<camera>/fringe_<image>.tif' cameras='{cam1: c0}' out=capture
"""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError, field_validator

from recon.capture import calibration_files, manifest
from recon.capture.manifest import OPTICS, BoardPart, BoardPose, Device, Manifest, SurfacePart
from recon.errors import InputError, one_line
from recon.files import atomic
from recon.image_folders import folder_reading, image_headers
from recon.image_folders.file_templates import CAMERAS, Words
from recon.image_folders.folder_reading import Expected, Reading
from recon.model.boards import Board
from recon.model.patterns import Patterns
from recon.model.rig import Part
from sonotwin import choices

Camera = Literal["cam1", "cam2"]
LEAST_PX = 8  # of an image's shorter side


class Config(Part):
    """Fields of `sonotwin describe`."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    folder: Path
    """of the images (PNG, BMP, TIFF, JPEG), in folders or not; they stay where they are"""
    out: Path
    """the capture folder to write: a manifest that points at them, and the calibration"""
    board: dict[str, Any] | None = None
    """a calibration board in several poses: kind, columns, rows and lengths in mm, see docs/captures.md; null: a surface"""
    patterns: str | None = None
    """YAML file of the pattern sequence, or the name of one in conf/patterns; null: a board without fringes"""
    calibration: Path | None = None
    """of cameras and projector, to be copied into the capture; a surface needs it, here or later"""
    files: str | tuple[str, ...] | None = None
    """names of the images below folder, '<camera>/<pose>/<image>.png'; a list of several; null: as they are usually. <image>
    is a number or a whole name, * anything; without <image> they are the lit ones; others are left out"""
    cameras: dict[Camera, str] | None = None
    """words for <camera>: {cam1: left, cam2: right}; null: cam1, camera1 or left, and cam2, camera2 or right"""
    lit: tuple[str, ...] = ("lit", "white")
    """in the place of <image>: names of the board's images in even light; a sole image of a pose is lit anyway"""
    bits: Literal[8, 10, 12] | None = None
    """8, 10 or 12, of all cameras; null: 8, and of 16-bit images 10 or 12 by the brightest of a pose"""

    @field_validator("cameras")
    @classmethod
    def _one_word_each(cls, value: dict[Camera, str] | None) -> dict[Camera, str] | None:
        words = [word.lower() for word in (value or {}).values()]
        if len(set(words)) < len(words):
            raise ValueError(f"expected another word for each camera, found {words[0]} for both")
        return value


def run(config: Config) -> None:
    """Read names and headers of the images, and write the manifest.

    Raises
    ------
    InputError
        If images or names are missing, have two meanings or contradict each other, or `out` can't be written to.
    """
    sources = [config.folder, config.calibration, config.patterns]
    inputs = [Path(source) for source in sources if source is not None and Path(source).exists()]
    atomic.check_folder(config.out, "describe", inputs=inputs)
    if config.board is None and config.patterns is None:
        raise InputError("describe: expected board, patterns or both, found none; give board={kind: ...} or patterns=NAME")
    board = None if config.board is None else design(config.board)
    patterns = None if config.patterns is None else choices.read_patterns(config.patterns)
    expected = Expected(board is not None, 0 if patterns is None else patterns.count, config.patterns or "")
    paths = folder_reading.image_paths(config.folder)
    reading = read(config, paths, expected)
    devices = devices_of(config, reading, patterns)
    files = {camera: [config.folder / path for path in reading.paths(camera)] for camera in reading.cameras}
    altered = {camera: signs for camera, paths in files.items() if (signs := image_headers.processing(paths))}
    part = {"surface": surface(reading, patterns)} if board is None else {"board": poses(reading, board, patterns)}
    write(config, part, devices)
    for line in lines(reading, patterns, devices, len(paths)):
        print(line)
    for camera, signs in altered.items():
        unknown = "`sonotwin identify` can't measure the camera's noise by them"
        print(f"not raw     {camera}: images are {signs}: {unknown}; record raw grey ones, as PNG or TIFF, for that")
    print(f"wrote       {config.out}")
    print(f"next        {next_command(config)}")


def design(fields: Mapping[str, Any]) -> Board:
    """The board's design; raises InputError with the field that is wrong."""
    try:
        return TypeAdapter(Board).validate_python(fields)
    except ValidationError as error:
        kind = fields.get("kind")  # which pydantic names among the fields
        raise InputError(f"board.{one_line(error).removeprefix(f'{kind}.')}") from None


def read(config: Config, paths: list[str], expected: Expected) -> Reading:
    """Cameras, poses and order of the images, by given templates or by the usual ones."""
    cameras = CAMERAS if config.cameras is None else {word.lower(): camera for camera, word in config.cameras.items()}
    words = Words(cameras, config.lit if expected.board else ())
    if config.files is None:
        return folder_reading.find(config.folder, paths, expected, words)
    templates = (config.files,) if isinstance(config.files, str) else config.files
    return folder_reading.by_templates(config.folder, paths, expected, words, templates)


def devices_of(config: Config, reading: Reading, patterns: Patterns | None) -> dict[str, Device]:
    """Cameras by the headers of all images, and by their levels where they have 16 bits; the projector by the patterns."""
    devices = {}
    for camera in reading.cameras:
        paths = [config.folder / path for path in reading.paths(camera)]
        size = image_headers.common_size(paths)
        if min(size) < LEAST_PX:
            raise InputError(f"{paths[0]}: expected {LEAST_PX}x{LEAST_PX} px or more, found {size[0]}x{size[1]}")
        devices[camera] = Device(size=size, bits=config.bits or image_headers.bits(paths))
    return devices if patterns is None else devices | {"projector": Device(size=patterns.projector_size)}


def surface(reading: Reading, patterns: Patterns | None) -> SurfacePart:
    """The surface part."""
    assert patterns is not None  # as there is no board
    return SurfacePart(patterns=patterns, images={camera: view.paths for (_, camera), view in reading.views.items()})


def poses(reading: Reading, board: Board, patterns: Patterns | None) -> BoardPart:
    """The board part; raises InputError if the patterns don't suit it."""
    records = []
    for pose in reading.poses:
        views = {camera: view for (own, camera), view in reading.views.items() if own == pose}
        lit = {camera: view.lit[0] for camera, view in views.items() if view.lit}
        fringes = {camera: view.sequence for camera, view in views.items() if view.sequence}
        records.append(BoardPose(name=pose, lit=lit, fringes=fringes))
    try:
        return BoardPart(board=board, patterns=patterns, poses=tuple(records))
    except ValidationError as error:
        raise InputError(f"describe: {one_line(error)}") from None


def write(config: Config, part: Mapping[str, SurfacePart | BoardPart], devices: Mapping[str, Device]) -> None:
    """Write the capture folder, whole or not at all."""
    sizes = {name: device.size for name, device in devices.items()}
    optics = None if config.calibration is None else calibration_files.read_for(config.calibration, sizes)
    place = Path(os.path.abspath(config.out))
    root = Path(os.path.relpath(config.folder.resolve(), place.parent.resolve() / place.name)).as_posix()
    described = {"schema": manifest.SCHEMA, "name": config.folder.resolve().name, "root": root, "devices": devices, **part}
    with atomic.new_folder(config.out, "describe") as folder:
        if optics is not None:
            (folder / OPTICS).parent.mkdir()
            calibration_files.write(folder / OPTICS, optics)
            described["calibration"] = OPTICS
        manifest.write_manifest(folder, Manifest.model_validate(described))


def lines(reading: Reading, patterns: Patterns | None, devices: Mapping[str, Device], count: int) -> Iterator[str]:
    """Lines: poses, each camera's images, what is lacking and what was left out."""
    several = f"{len(reading.poses)} poses, {reading.poses[0]} to {reading.poses[-1]}" if reading.poses[0] else "a surface"
    yield f"found       {several}; names are {' or '.join(reading.templates)}"
    for camera in reading.cameras:
        views = [view for (_, own), view in reading.views.items() if own == camera]
        kinds = sorted({f"{len(view.lit)} lit, {len(view.sequence)} under patterns" for view in views}, reverse=True)
        width, height = devices[camera].size
        yield f"{camera:11} {len(views)} x {' or '.join(kinds)}; {width}x{height}, {devices[camera].bits} bits"
        for what, lacking in (("images", reading.unseen(camera)), ("fringes", reading.without_sequence(camera))):
            if lacking:
                yield f"lacking     {what} of {camera} in {', '.join(lacking)}"
    if patterns is not None:
        yield "projector   {}x{}, {} patterns".format(*patterns.projector_size, patterns.count)
    if left_out := count - sum(len(view.paths) for view in reading.views.values()):
        yield f"left out    {left_out} images, whose names are others"


def next_command(config: Config) -> str:
    """The command that takes the capture."""
    capture = quote(f"capture={config.out}")
    if config.board is not None:
        return f"sonotwin calibrate-optics {capture} out=calibration"
    return f"sonotwin surface {capture} {'' if config.calibration else 'calibration=optics.yaml '}out=surface"
