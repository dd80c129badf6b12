"""A scanner's own recording: whole screens with the B-scan in its place, and a tracker's table, as `import-sweep` reads them."""

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.capture import manifest, probe_files, sweep_part, sweep_tables
from recon.capture.images import Size, write_images
from recon.capture.manifest import MANIFEST, image_name
from recon.capture.sweep_part import SweepCapture
from recon.clips import image_region
from recon.clips.clip import Box
from recon.clips.pose_tables import Columns
from recon.errors import InputError
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from sonotwin import command_line
from sonotwin.export_layouts import Settings
from sonotwin.verbs import import_sweep

Grey = NDArray[np.uint8]
Times = NDArray[np.int64]

TAKES = ("capture", "sweep", "implausible", "probe", "screen_px")
ABOUT = "of a sweep's B-scans and poses alone"
SCREENS, POSES = "screen", "poses.csv"
COLUMNS = Columns(time="time", translation=("x", "y", "z"), quaternion=("qx", "qy", "qz", "qw"))  # s, mm
BRIGHT, FAINT, HEADER = 190, 95, 26  # grey levels


@dataclass(frozen=True)
class Room:
    """Room around the B-scan for all that a scanner shows beside it, px."""

    above: int = 76  # the header, and the mark of the probe's side
    below: int = 28
    left: int = 60  # the bar of greys
    ruler: int = 60  # to the right of the B-scan
    column: int = 124  # of settings, at the screen's right end

    def least(self, scan: Size) -> Size:
        """The least screen for B-scans of a size."""
        return scan[0] + self.left + self.ruler + self.column, scan[1] + self.above + self.below


ROOM = Room()


def write(folder: Path, settings: Settings) -> list[str]:
    """Write all B-scans, with a pose or without, and all rows of the track.

    Raises
    ------
    InputError
        If the capture or the probe's calibration is damaged, there is no such sweep, it has less than two B-scans or poses,
        none of its B-scans has a pose, they pause, or they don't fit into the screen.
    """
    sweep = sweep_part.read_sweep(settings.source, settings.sweep, "volume", settings.implausible)
    _, part = manifest.read_manifest(settings.source).sweep_of(settings.source / MANIFEST, "a sweep", settings.sweep, "volume")
    for count, what in ((len(sweep.paths), "B-scans"), (len(sweep.track.times), "poses")):
        if count < 2:
            raise InputError(f"{settings.source}: expected two {what} or more, as import-sweep takes, found {count}")
    found, placed = sweep.track.found, np.isfinite(sweep.poses()).all(axis=(1, 2))
    box, (starts_s, rate_hz, off_s) = place(sweep.size, settings.screen_px), even_clock(sweep.times, str(settings.source))
    probe = sweep.probe if settings.probe is None else probe_files.read(settings.probe)
    still = background(settings.screen_px, box, rate_hz, probe)
    for number, screen in enumerate(screens(sweep, still, box)):
        write_images([folder / SCREENS / image_name(number)], screen[None])
    write_poses(folder / POSES, sweep.track)
    alone = _found(screens(sweep, still, box)) == box
    reading = import_sweep.Config(
        clip=settings.out / SCREENS,
        poses=settings.out / POSES,
        columns=COLUMNS,
        starts_s=starts_s,
        rate_hz=rate_hz,
        crop="auto" if alone else box,
        purpose=part.purpose or "volume",
        implausible=settings.implausible,
        out=Path("FOLDER"),
    )
    width, height = settings.screen_px
    finds = "which import-sweep finds by itself" if alone else "to be given, as they don't change out to their edges"
    return [
        f"screen      {len(sweep.paths)} images of {width}x{height}, B-scans at crop=[{','.join(map(str, box))}], {finds}",
        f"poses       {found.sum()} of {len(found)} rows; {placed.sum()} of {len(placed)} B-scans have one",
        f"clock       {rate_hz:.4g} B-scans a second, which are {1e3 * off_s:.2f} ms off their time stamps at most",
        f"read        {shlex.join(['sonotwin', *command_line.words('import-sweep', reading)])}",
    ]


def place(scan: Size, screen: Size) -> Box:
    """The B-scan's place: below the header, midway between the bar of greys and the ruler; InputError if it doesn't fit."""
    least = ROOM.least(scan)
    if screen[0] < least[0] or screen[1] < least[1]:
        needed, found, own = ("{}x{}".format(*size) for size in (least, screen, scan))
        expected = f"{needed} px or more, for B-scans of {own} and all that is beside them"
        raise InputError(f"export: screen_px: expected {expected}, found {found}; give screen_px=[{least[0]},{least[1]}]")
    return ROOM.left + (screen[0] - least[0]) // 2, ROOM.above, *scan


def screens(sweep: SweepCapture, still: Grey, box: Box) -> Iterator[Grey]:
    """The screen at each B-scan : (h, w); they differ in the B-scan, its number, and a clock of its time stamp."""
    u, v, width, height = box
    for number, time in enumerate(sweep.times.tolist()):
        screen = still.copy()
        screen[v : v + height, u : u + width] = sweep.image(number)
        minutes, hundredths = divmod(time // 10_000_000 % 360_000, 6000)  # of an hour
        _text(screen, f"{minutes:02d}:{hundredths // 100:02d}.{hundredths % 100:02d}", (still.shape[1] - 88, 28))
        _text(screen, f"{number + 1}/{len(sweep.paths)}", _setting_at(still, 0))
        yield screen


def background(size: Size, box: Box, rate_hz: float, probe: ProbeCalibration | None) -> Grey:
    """All that screens show beside the B-scan and never changes : (h, w). Patient and date stay empty."""
    screen = np.zeros(size[::-1], np.uint8)
    (wide, _), (u, v, width, height), header_px = size, box, 44
    screen[:header_px] = HEADER
    cv2.line(screen, (0, header_px), (wide, header_px), FAINT)
    _text(screen, "sonotwin", (16, 29), 0.6)
    _text(screen, "ID ------", (wide // 2 - 110, 28))
    _text(screen, "--/--/----", (wide - 186, 28))

    left, right, rows = 20, 34, min(256, height)
    for row, level in enumerate(np.linspace(255, 0, rows)):
        cv2.line(screen, (left, v + row), (right, v + row), int(level))
    corners = [(left - 1, v - 1), (right + 1, v - 1), (right + 1, v + rows), (left - 1, v + rows)]
    for one, other in zip(corners, [*corners[1:], corners[0]], strict=True):
        cv2.line(screen, one, other, FAINT)

    side = u + 6, v - 13
    cv2.line(screen, side, side, BRIGHT, 9)  # a dot at the end of the array where the probe has its own mark

    settings = [("Frame", ""), ("Image", f"{width}x{height}"), ("Rate", f"{rate_hz:.3g} Hz")]
    if probe is not None:
        _draw_ruler(screen, box, probe)
        deepest_mm = (height - probe.face_row) * probe.scale[1]
        settings += [("Depth", f"{deepest_mm / 10:.1f} cm"), ("Sound", f"{probe.speed_m_s:.0f} m/s")]
    for line, (name, value) in enumerate(settings):
        column, row = _setting_at(screen, line)
        _text(screen, name, (column, row - 18), 0.4, FAINT)
        _text(screen, value, (column, row))
    return screen


def _draw_ruler(screen: Grey, box: Box, probe: ProbeCalibration) -> None:
    """Draw ticks of depth below the probe's face, each 5 and 10 mm, numbers in cm, and a focus in the middle."""
    u, v, width, height = box
    column, last, px_per_mm = u + width + 16, v + height - 1, 1 / probe.scale[1]
    cv2.line(screen, (column, v), (column, last), FAINT)
    numbered_mm = next((step for step in (10, 20, 50, 100) if step * px_per_mm >= 26), 1000)
    step_mm = 5 if px_per_mm >= 1 else numbered_mm
    for depth in np.arange(0, (height - probe.face_row) / px_per_mm, step_mm):
        row = v + round(probe.face_row + depth * px_per_mm)
        if v <= row <= last:
            cv2.line(screen, (column, row), (column + (5 if depth % 10 else 9), row), FAINT if depth % 10 else BRIGHT)
            if depth % numbered_mm == 0:
                _text(screen, f"{depth / 10:.0f}", (column + 15, row + 4), 0.4)
    for k in range(7):
        cv2.line(screen, (column - 10 + k, v + height // 2 - k), (column - 10 + k, v + height // 2 + k), BRIGHT)


def _setting_at(screen: Grey, line: int) -> tuple[int, int]:
    """Lower left end of a setting's value, in the column at the right."""
    return screen.shape[1] - ROOM.column + 12, ROOM.above + 28 + 44 * line


def _text(screen: Grey, words: str, at: tuple[int, int], scale: float = 0.45, level: int = BRIGHT) -> None:
    cv2.putText(screen, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, level, 1, cv2.LINE_AA)


def _found(shown: Iterator[Grey]) -> Box | None:
    """The B-scan's part as `import-sweep` finds it."""
    try:
        return image_region.find(shown, "screen", "crop")
    except InputError:
        return None


def even_clock(times: Times, name: str) -> tuple[float, float, float]:
    """First time, s, and rate, Hz, of even times that are nearest to time stamps : (n,) ns; and the most that one is off, s.

    The first time is in whole ns, and the rate has the fewest digits by which the last time is right to half a one.

    Raises
    ------
    InputError
        If a stamp is off by more than half a period, as after a pause: poses of other B-scans would be nearer.
    """
    seconds, numbers = 1e-9 * (times - times[0]), np.arange(len(times))
    first, period = np.polynomial.polynomial.polyfit(numbers, seconds, 1)
    off = float(np.abs(seconds - first - period * numbers).max())
    if off > period / 2:
        apart = np.diff(seconds)
        found = f"{apart.min():.4g} to {apart.max():.4g} s between them, the longest after B-scan {apart.argmax() + 1}"
        raise InputError(
            f"{name}: expected B-scans at an even rate, as images have no times of their own, found {found}; "
            "give layout=meza2021 frames=false, which has a pose for each"
        )
    rates = (float(f"{1 / period:.{digits}g}") for digits in range(1, 18))
    rate = next(rate for rate in rates if abs(1 / rate - period) * numbers[-1] < 0.5e-9)
    return float(Decimal(int(times[0]) + round(1e9 * first)).scaleb(-9)), rate, off


def write_poses(path: Path, track: Track) -> None:
    """Write a row a pose, by COLUMNS, with all digits; empty but for the time where the target wasn't found."""

    def row(time: int, pose: NDArray[np.float64]) -> list[object]:
        values = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] if np.isfinite(pose).all() else [""] * 7
        return [f"{Decimal(time).scaleb(-9):f}", *values]

    sweep_tables.write_rows(path, COLUMNS.names, (row(*each) for each in zip(track.times.tolist(), track.poses, strict=True)))
