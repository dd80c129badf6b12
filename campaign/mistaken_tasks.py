"""Tasks in which mistakes are made: commands with the sources that they need, their figures, and the mistakes that fit them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from campaign import capture_mistakes as made
from campaign import device_mistakes, pose_mistakes, probe_mistakes
from campaign import mistake_figures as figures_of
from campaign.capture_mistakes import Mistake, both, given, json_field, reordered, seen, swapped, taken_from
from campaign.mistake_figures import Figures

Line = tuple[str, ...]


@dataclass(frozen=True)
class Task:
    """One or more commands in a folder of links to sources."""

    name: str  # the verb that is judged
    commands: tuple[Line, ...]
    folders: tuple[str, ...]
    figures: Callable[[Path], Figures]
    mistakes: tuple[Mistake, ...]

    def lines(self, fields: Line) -> list[Line]:
        """The command lines with other fields in the first."""
        verb, *usual = self.commands[0]
        names = {field.partition("=")[0] for field in fields}
        first = (verb, *(field for field in usual if field.partition("=")[0] not in names), *fields)
        return [first, *self.commands[1:]]


def _images(
    folder: str, what: str, order: tuple[str, ...] = ("exchanged", "shuffled", "reversed", "doubled", "late")
) -> list[Mistake]:
    """Mistakes in the images of a folder."""
    words = {
        "exchanged": ("order", "two images exchanged", r"order|exchang|follow"),
        "shuffled": ("order", "images shuffled", r"order|follow|shuffl|jump"),
        "reversed": ("order", "images in reversed order", r"order|revers|follow|backwards|direction"),
        "doubled": ("doubled", "an image taken twice", r"twice|doubled|order|same|repeat|follow"),
        "late": ("late", "images late by one", r"late|order|follow|lag"),
        "frozen": ("frozen", "images frozen from one on", r"frozen|same|repeat|identical|still"),
    }
    found = [
        Mistake(kind, f"{what}: {text}", cause, reordered(folder, how))
        for how, (kind, text, cause) in words.items()
        if how in order
    ]
    for how, text in ((made.mirrored, "mirrored"), (made.upside_down, "upside down"), (made.turned, "turned by 180 degrees")):
        found.append(Mistake("mirrored", f"{what}: {text}", r"mirror|turned|flip|upside|left-handed", seen(f"{folder}/*", how)))
    return found


PATTERNS = "ball/capture/manifest.json"


def _patterns(path: str, prefix: str, size: list[int]) -> list[Mistake]:
    """Mistakes in what is told of the fringes: other sequences of as many images."""
    parts, words = f"{prefix}.parts.1", r"pattern|pitch|steps|order|line|projector|period|code"
    other = [size[0] + 640, size[1] + 280]
    return [
        Mistake("field", "another pitch", words, json_field(path, f"{parts}.pitch", lambda pitch: pitch * 4 / 3)),
        Mistake("field", "pitch in mm", words, json_field(path, f"{parts}.pitch", 1.5)),
        Mistake("field", "first step 0 for 1", words, json_field(path, f"{parts}.first", 0)),
        Mistake("field", "steps the other way", words, json_field(path, f"{parts}.backwards", True)),
        Mistake("field", "rows for columns", words, both(
            json_field(path, f"{prefix}.parts.0.axis", "rows"), json_field(path, f"{parts}.axis", "rows"))),
        Mistake("field", "another projector's size", words + "|size", both(
            json_field(path, f"{prefix}.projector_size", other), json_field(path, "devices.projector.size", other))),
        Mistake("field", "centre line elsewhere", words, json_field(path, f"{prefix}.parts.0.position", size[0] / 2 + 12)),
    ]  # fmt: skip


CAM1 = "ball/capture/surface/cam1"
SURFACE = Task(
    "surface",
    (("surface", "capture=ball/capture", "out=new"),),
    ("ball", "both"),
    lambda folder: figures_of.surface(folder / "new"),
    (
        *_images(CAM1, "fringes"),
        Mistake("device", "camera 2's images", r"camera|calibration|another", taken_from("both/capture/surface/cam2", CAM1)),
        Mistake("field", "images with a screen's gamma", r"gamma|linear|response", seen(f"{CAM1}/*", made.with_gamma)),
        Mistake("field", "images stretched one by one", r"gain|stretch|bright|follow", seen(f"{CAM1}/*", made.stretched)),
        *_patterns(PATTERNS, "surface.patterns", [1280, 800]),
        *device_mistakes.of_optics("ball/capture/calibration/optics.yaml", ("cam1", "projector")),
        Mistake("device", "cam2's calibration for cam1", r"camera|calibration|another|agree", both(
            device_mistakes.optics("both/capture/calibration/optics.yaml", device_mistakes.exchanged("cam1", "cam2")),
            given("calibration=both/capture/calibration/optics.yaml"))),
        Mistake("field", "camera=cam2", r"cam2|camera", given("camera=cam2")),
    ),
)  # fmt: skip

BOARD, CAMS = "board/capture/manifest.json", "board/capture/board"


def _length(name: str, factor: float) -> made.Change:
    return json_field(BOARD, f"board.board.{name}", lambda value: value * factor)


def _every_part(kind: str, field: str, how: Callable[[Any], Any]) -> made.Change:
    """A field of all parts of a kind in the board's patterns."""

    def change(folder: Path, rng: made.Rng) -> Line:
        content = json.loads((folder / BOARD).read_text(encoding="utf-8"))
        for part in content["board"]["patterns"]["parts"]:
            if part["kind"] == kind:
                part[field] = how(part.get(field))
        made.write(folder / BOARD, json.dumps(content))
        return ()

    return change


def _lit(camera: str, order: Callable[[int], list[int]]) -> made.Change:
    """The lit images of a camera in another order of the poses."""

    def change(folder: Path, rng: made.Rng) -> Line:
        paths = sorted(folder.glob(f"{CAMS}/*/{camera}/lit.png"))
        kept = [path.read_bytes() for path in paths]
        for path, k in zip(paths, order(len(paths)), strict=True):
            made.write(path, kept[k])
        return ()

    return change


def _pose_twice(folder: Path, rng: made.Rng) -> Line:
    """All images of a pose in the place of another's."""
    for path in sorted((folder / CAMS / "03").rglob("*.png")):
        made.write(path, (folder / CAMS / "01" / path.relative_to(folder / CAMS / "03")).read_bytes())
    return ()


def _closer(image: NDArray) -> NDArray:
    """As of a lens that is zoomed by 3 %."""
    height, width = image.shape
    return cv2.warpAffine(image, np.array([[1.03, 0, -0.015 * width], [0, 1.03, -0.015 * height]]), (width, height))


UNIT, SIZE = r"unit|metres|inch|spacing|diameter", r"size|spacing|diameter|print|design"
MIXED = r"exchang|mixed|contradict|pose|move|mirror"
OPTICS = Task(
    "calibrate-optics",
    (("calibrate-optics", "capture=board/capture", "out=new"),),
    ("board",),
    lambda folder: figures_of.optics(folder / "new"),
    (
        *(
            Mistake("units", f"board in {name}", UNIT, both(_length("spacing_mm", f), _length("diameter_mm", f)))
            for name, f in made.UNITS.items()
        ),
        Mistake("field", "circles' distance for rows'", SIZE, _length("spacing_mm", 2)),
        Mistake("field", "another spacing", SIZE, _length("spacing_mm", 4 / 3)),
        Mistake("field", "another diameter", SIZE, _length("diameter_mm", 0.7)),
        Mistake("field", "radius for diameter", SIZE, _length("diameter_mm", 0.5)),
        Mistake("field", "print scaled to the page, by 94 %", SIZE, both(
            _length("spacing_mm", 1 / 0.94), _length("diameter_mm", 1 / 0.94))),
        Mistake("field", "rows and columns exchanged", r"row|column|exchang", both(
            json_field(BOARD, "board.board.columns", 11), json_field(BOARD, "board.board.rows", 4))),
        Mistake("field", "a row too few", r"row|column|circle", json_field(BOARD, "board.board.rows", lambda rows: rows - 1)),
        Mistake("field", "symmetric circles", r"kind|symmetric|circle|grid", json_field(
            BOARD, "board.board.kind", "symmetric_circles")),
        Mistake("device", "cameras exchanged in one pose", MIXED, swapped(f"{CAMS}/01/cam1/lit.png", f"{CAMS}/01/cam2/lit.png")),
        Mistake("device", "camera 2's lens zoomed on the way", r"focal|" + MIXED, seen(f"{CAMS}/0[0-1]/cam2/*", _closer)),
        Mistake("mirrored", "camera 2 mirrored", r"mirror|turned|flip", seen(f"{CAMS}/*/cam2/*", made.mirrored)),
        Mistake("mirrored", "all images mirrored", r"mirror|turned|flip", seen(f"{CAMS}/*/*/*", made.mirrored)),
        Mistake("mirrored", "camera 2 turned by 180 degrees", r"turned|flip|" + MIXED, seen(f"{CAMS}/*/cam2/*", made.turned)),
        Mistake("order", "camera 2's poses reversed", MIXED, _lit("cam2", lambda n: list(range(n))[::-1])),
        Mistake("order", "two of camera 2's poses exchanged", MIXED, _lit("cam2", lambda n: [0, 2, 1, *range(3, n)])),
        Mistake("late", "camera 2 late by a pose", r"late|" + MIXED, _lit("cam2", lambda n: [n - 1, *range(n - 1)])),
        Mistake("frozen", "camera 2 frozen from a pose on", r"same|" + MIXED, _lit("cam2", lambda n: [0, 1, *[2] * (n - 2)])),
        Mistake("doubled", "a pose taken twice", r"twice|same|doubled|repeat|poses", _pose_twice),
        *_images(f"{CAMS}/01/cam1", "images of one pose", ("exchanged", "reversed", "doubled", "late")),
        Mistake("field", "another projector's size", r"size|pattern|projector|code", both(
            json_field(BOARD, "board.patterns.projector_size", [1024, 800]),
            json_field(BOARD, "devices.projector.size", [1024, 800]))),
        Mistake("field", "another first step", r"pattern|step|order|period|first", _every_part(
            "fringes", "first", lambda first: (first or 0) + 1)),
        Mistake("field", "steps the other way", r"pattern|step|order|backwards", _every_part(
            "fringes", "backwards", lambda backwards: not backwards)),
        Mistake("field", "fringes and code of another pitch", r"pattern|pitch|code|period", both(
            *(_every_part(kind, "pitch", lambda pitch: pitch + 2) for kind in ("fringes", "gray")))),
        Mistake("field", "pixels of a screen for the projector's", r"size|pattern|projector|code", both(
            json_field(BOARD, "board.patterns.projector_size", [1920, 1080]),
            json_field(BOARD, "devices.projector.size", [1920, 1080]))),
    ),
)  # fmt: skip

WIRES = "wires/capture/sweep"
SCANNED = ("exchanged", "shuffled", "reversed", "doubled", "late", "frozen")
PROBE = Task(
    "calibrate-probe",
    (("calibrate-probe", "capture=wires/capture", "out=new"),),
    ("wires", "bottom"),
    lambda folder: figures_of.probe(folder / "new"),
    (
        *pose_mistakes.of_poses(f"{WIRES}/track.csv"),
        *pose_mistakes.of_stamps(f"{WIRES}/us/timestamps.csv"),
        *_images(f"{WIRES}/us", "B-scans", SCANNED),
        Mistake("device", "B-scans of another sweep", r"crossing|found|echo|contradict", taken_from(
            "bottom/capture/sweep/us", f"{WIRES}/us")),
        Mistake("units", "temperature in Fahrenheit", r"temperature|deg", given("temperature_c=72")),
        Mistake("units", "temperature in kelvin", r"temperature|deg", given("temperature_c=295")),
        Mistake("field", "ice water for warm", r"temperature|sound|speed|scale", given("temperature_c=2")),
        Mistake("units", "scanner's scale in cm", r"scale", given(
            "rig.probe.scale_mm_per_px=[0.012,0.012]", "temperature_c=22")),
        Mistake("device", "another scanner's scale", r"scale|scanner", given(
            "rig.probe.scale_mm_per_px=[0.2,0.2]", "temperature_c=22")),
        Mistake("late", "a lag that isn't", r"lag|late|rest|moved", given("lag_s=0.05")),
    ),
)  # fmt: skip


def _set_up(source: str) -> tuple[Mistake, ...]:
    """Wrong set-ups of a sweep over a phantom at rest, with the probe at rest in each B-scan."""
    sweep = f"{source}/capture/sweep"
    return (
        *pose_mistakes.of_poses(f"{sweep}/track.csv"),
        *(one for one in _images(f"{sweep}/us", "B-scans", ()) if one.kind == "mirrored"),
        *probe_mistakes.of_motion(f"{sweep}/track.csv"),
        *probe_mistakes.of_clip(321, 408),
    )


def _wired(name: str, source: str, fields: Line, mistakes: tuple[Mistake, ...], folders: Line = ()) -> Task:
    """A calibration by a phantom."""
    return Task(
        f"calibrate-probe, {name}",
        (("calibrate-probe", f"capture={source}/capture", *fields, "out=new"),),
        (source, *folders),
        lambda folder: figures_of.probe(folder / "new"),
        mistakes,
    )


ROWED = ("phantom=n_wires",)
WIRED = (
    _wired("crossed wires", "wires_in_full", (), (
        *_set_up("wires_in_full"), Mistake("device", "N-wires", r"dots|rows|phantom|wires", given("phantom=n_wires"))
    )),
    _wired("N-wires", "rows_in_full", ROWED, (*_set_up("rows_in_full"), *probe_mistakes.of_rows())),
    *(
        _wired(f"{name} in motion", source, (*fields, "lag_s=0.05"), tuple(
            probe_mistakes.of_lag(f"{source}/capture/sweep/us/timestamps.csv")
        ))
        for name, source, fields in (("crossed wires", "moving", ()), ("N-wires", "moving_rows", ROWED))
    ),
)  # fmt: skip

BOTTOM = "bottom/capture/sweep"
LAG = Task(
    "measure-lag",
    (("measure-lag", "capture=bottom/capture", "out=new"),),
    ("bottom", "wires"),
    lambda folder: figures_of.lag(folder / "new"),
    (
        *(  # lateness is what it measures
            one
            for one in (*pose_mistakes.of_poses(f"{BOTTOM}/track.csv"), *pose_mistakes.of_stamps(f"{BOTTOM}/us/timestamps.csv"))
            if one.kind != "late"
        ),
        *_images(f"{BOTTOM}/us", "B-scans", tuple(how for how in SCANNED if how != "late")),
        Mistake("device", "B-scans of another sweep", r"bottom|found", taken_from("wires/capture/sweep/us", f"{BOTTOM}/us")),
        Mistake("units", "lags sought in ms", r"search|lag", given("search_s=[-300,600]")),
    ),
)  # fmt: skip

FILM = "film/capture/sweep"
VIEWS = r"exchang|swap|calibration|apart|agree|mirror"


def _target(field: str, value: str) -> made.Change:
    return given(f"rig.target.{field}={value}")


def _of_film(camera: str) -> list[Mistake]:
    return [
        *_images(f"{FILM}/{camera}", f"{camera}'s frames", ("reversed", "late", "frozen", "shuffled")),
        *pose_mistakes.of_stamps(f"{FILM}/{camera}/timestamps.csv"),
    ]


FILMED = (
    *_of_film("cam2"),
    *device_mistakes.of_optics("film/capture/calibration/optics.yaml", ("cam1", "cam2")),
    Mistake("device", "cameras exchanged", VIEWS, swapped(f"{FILM}/cam1", f"{FILM}/cam2")),
    Mistake("device", "one camera's frames twice", VIEWS + "|same", taken_from(f"{FILM}/cam1", f"{FILM}/cam2")),
    Mistake("field", "c1 and c2 exchanged", r"design|apart|c1", both(_target("c1_mm", "40"), _target("c2_mm", "25"))),
    Mistake("units", "target in cm", r"design|unit|diameter", both(
        _target("c1_mm", "2.5"), _target("c2_mm", "4"), _target("outer_diameter_mm", "1.8"),
        _target("inner_diameter_mm", "0.72"))),
    Mistake("units", "target in inches", r"design|unit|diameter", both(
        _target("c1_mm", "0.984"), _target("c2_mm", "1.575"), _target("outer_diameter_mm", "0.709"),
        _target("inner_diameter_mm", "0.283"))),
    Mistake("field", "another distance of the circles", r"design|apart", _target("c1_mm", "30")),
    Mistake("field", "another diameter", r"design|diameter", both(
        _target("outer_diameter_mm", "20"), _target("inner_diameter_mm", "8"))),
    Mistake("field", "radii for diameters", r"design|diameter", both(
        _target("outer_diameter_mm", "9"), _target("inner_diameter_mm", "3.6"))),
    Mistake("field", "print scaled to the page, by 94 %", r"design|scale", both(
        _target("c1_mm", "26.6"), _target("c2_mm", "42.55"), _target("outer_diameter_mm", "19.15"),
        _target("inner_diameter_mm", "7.66"))),
)  # fmt: skip
TRACK = Task(
    "track", (("track", "capture=film/capture", "out=new", "overlays=false"),), ("film",),
    lambda folder: figures_of.poses(folder / "new"), FILMED,
)  # fmt: skip
TARGET = Task(
    "calibrate-target",
    (("calibrate-target", "capture=film/capture", "least_tilt_deg=0", "least_range_mm=0", "out=new"),),
    ("film",),
    lambda folder: figures_of.target(folder / "new"),
    FILMED,
)


def _swept(scan: str) -> tuple[Mistake, ...]:
    """Mistakes in a sweep of a source, with its probe."""
    sweep = f"{scan}/capture/sweep"
    return (
        *pose_mistakes.of_poses(f"{sweep}/track.csv"),
        *pose_mistakes.of_stamps(f"{sweep}/us/timestamps.csv"),
        *_images(f"{sweep}/us", "B-scans", SCANNED),
        *device_mistakes.of_probe(f"{scan}/capture/calibration/probe.yaml"),
        Mistake("units", "lag in ms", r"lag|pose", given("lag_s=50")),
        Mistake("late", "the lag's other sign", r"lag|sign", given("lag_s=-0.05")),
        Mistake("units", "speed of sound in mm/us", r"tissue_m_s|speed", given("tissue_m_s=1.45")),
        Mistake("units", "speed of sound in cm/s", r"tissue_m_s|speed", given("tissue_m_s=145000")),
        Mistake("field", "the speed of sound of bone", r"tissue_m_s|speed|sound", given("tissue_m_s=3500")),
        Mistake("field", "the speed of sound of fat for water's", r"tissue_m_s|speed|sound", given("tissue_m_s=1400")),
    )


FREEHAND = Task(
    "freehand",
    (("freehand", "capture=raster/capture", "lag_s=0.05", "out=new"),),
    ("raster",),
    lambda folder: figures_of.volume(folder / "new"),
    (
        *_swept("raster"),
        Mistake("units", "voxels in metres", r"spacing", given("spacing_mm=0.0005")),
        Mistake("units", "voxels of 50 mm", r"spacing|voxel", given("spacing_mm=50")),
        Mistake("field", "another clip", r"clip", given("clip=[400,10,100,100]")),
    ),
)
SEGMENT = Task(
    "segment",
    (("segment", "capture=raster/capture", "lag_s=0.05", "tissue_m_s=1450", "overlays=0", "out=new"),),
    ("raster",),
    lambda folder: figures_of.masses(folder / "new"),
    (
        *_swept("raster"),
        Mistake("field", "another dynamic range", r"dynamic|range", given("dynamic_range_db=40")),
        Mistake("field", "no speed of sound", r"tissue_m_s|speed|sound", given("tissue_m_s=null")),
        Mistake("late", "no lag", r"lag", given("lag_s=0")),
    ),
)
DESCRIBE = Task(
    "describe",
    (
        ("describe", "folder=shots", "patterns=patterns.yaml", "calibration=optics/optics.yaml", "out=described"),
        ("surface", "capture=described", "out=new"),
    ),
    ("shots", "patterns.yaml", "optics"),
    lambda folder: figures_of.surface(folder / "new"),
    (
        *_images("shots", "fringes"),
        *device_mistakes.of_optics("optics/optics.yaml", ("cam1", "cam2")),
        Mistake("field", "another sequence", r"pattern|image|expected", given("patterns=gray_surface")),
        Mistake("field", "images with a screen's gamma", r"gamma|linear|response", seen("shots/*", made.with_gamma)),
    ),
)


def _cell(column: str, how: Callable[[float], float]) -> made.Change:
    """A column of the foreign table of poses."""

    def change(folder: Path, rng: made.Rng) -> Line:
        header, *rows = [line.split(",") for line in (folder / "raster.csv").read_text(encoding="utf-8").splitlines()]
        k = header.index(column)
        for row in rows:
            row[k] = f"{how(float(row[k])):.9g}"
        made.write(folder / "raster.csv", "\n".join(",".join(row) for row in (header, *rows)) + "\n")
        return ()

    return change


def _all_of(columns: str, how: Callable[[float], float]) -> made.Change:
    return both(*(_cell(column, how) for column in columns))


POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")  # columns
CLIP = r"unit|column|clock|second|quaternion|speed|starts|metres"
IMPORT_SWEEP = Task(
    "import-sweep",
    (
        ("import-sweep", "clip=raster.dcm", "poses=raster.csv", "starts_s=100", "columns.time=t", "columns.translation=[x,y,z]",
         "columns.quaternion=[qx,qy,qz,qw]", "out=imported"),
        ("freehand", "capture=imported", "probe=probe/probe.yaml", "out=new"),
    ),
    ("raster.dcm", "raster.csv", "probe"),
    lambda folder: figures_of.volume(folder / "new"),
    (
        *(Mistake("units", f"positions in {name}", CLIP, _all_of("xyz", lambda x, f=f: x * f)) for name, f in made.UNITS.items()),
        Mistake("units", "times in ms", CLIP, _cell("t", lambda t: t * 1000)),
        Mistake("units", "times in us", CLIP, _cell("t", lambda t: t * 1e6)),
        Mistake("field", "a quaternion that begins with w", CLIP, given("columns.quaternion=[qw,qx,qy,qz]")),
        Mistake("field", "x and y exchanged", CLIP, given("columns.translation=[y,x,z]")),
        Mistake("late", "starts 0.3 s late", CLIP, given("starts_s=100.3")),
        Mistake("late", "starts 10 s late", CLIP, given("starts_s=110")),
        Mistake("frames", "poses the other way round", CLIP, given("columns.inverted=true")),
        Mistake("frozen", "all times equal", CLIP, _cell("t", lambda t: 100.0)),
        Mistake("frozen", "all poses equal", CLIP, both(*(_cell(name, lambda _: 0.5) for name in POSE))),
    ),
)  # fmt: skip

TASKS = (SURFACE, OPTICS, PROBE, *WIRED, LAG, TRACK, TARGET, FREEHAND, SEGMENT, DESCRIBE, IMPORT_SWEEP)
