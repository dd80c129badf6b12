"""N-wires, as phantoms of the PLUS toolkit have them: their dots by `wire_dots`, the calibration by `line_calibration`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.probe_calibration import lateness, line_calibration, plus_phantom, wire_dots
from recon.probe_calibration.cross_wire import SEVERAL, Appearance
from recon.probe_calibration.line_calibration import MIN_FRAMES, DotSightings, LineAdjustment, Registration, Wires
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.plus_phantom import PlusPhantom
from recon.probe_calibration.tank_calibration import Settings
from recon.probe_calibration.wire_dots import Dots

Array = NDArray[np.float64]

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "find", "misfit", "others", "read", "sight"]
SHOWS = "dots of all wires"
WAYS = {
    "no echo stands out": "another scanner? give appearance.min_contrast_db",
    "too few dots": "are all wires in view? faint or broad ones? give appearance.min_contrast_db or appearance.max_extent_px",
    wire_dots.NO_ROW: "are these N-wires, across the image?",
    wire_dots.UNLIKE: "is wires= the definition of this phantom? another one, or wires put in other holes, look so",
    SEVERAL: "reverberations? give clip=[u,v,width,height] without them",
}


def read(settings: Settings, reference: str | None) -> PlusPhantom:
    """The wires of a configuration, without its registration where that is to be found."""
    phantom = plus_phantom.FCAL if settings.wires is None else plus_phantom.read(settings.wires, reference)
    if settings.registration == "known" and phantom.reference_from_phantom is None:
        where = "a sequence, for whose frames wires= has it" if reference is None else f"PhantomTo{reference} in wires="
        raise InputError(f"registration: expected {where}, found none; registration=free needs none")
    return replace(phantom, reference_from_phantom=None) if settings.registration == "free" else phantom


def find(image: NDArray, appearance: Appearance | None, known: PlusPhantom) -> Dots:
    """Find the dots."""
    return wire_dots.find(image, known.wires, appearance)


def sight(seen: Sequence[Dots], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float) -> DotSightings:
    """The dots in n frames, in all arrangements."""
    most = max((len(each.arrangements) for each in seen), default=1)
    count = seen[0].arrangements.shape[1] if seen else 0
    pixels, own = np.full((len(seen), most, count, 2), np.nan), np.full((len(seen), most, count, 2, 2), np.nan)
    for k, each in enumerate(seen):
        pixels[k, : len(each.arrangements)], own[k, : len(each.arrangements)] = each.arrangements, each.covariance
    return DotSightings(poses, pixels, own, covariance, rates, lag_sigma_s)


def _wires(known: PlusPhantom, settings: Settings) -> Wires:
    """The wires with their registration, if they have one."""
    registration = None
    if known.reference_from_phantom is not None:
        registration = Registration(rigid.nearest(known.reference_from_phantom), settings.registration_sigma_mm)
    return Wires(known.wires, settings.wire_place_sigma_mm, registration, settings.echo_ahead_mm, settings.echo_ahead_sigma_mm)


def misfit(frames: PhantomFrames, settings: Settings) -> float:
    """Mean square distance of the dots from their wires, as `line_calibration.misfit`."""
    return line_calibration.misfit(frames.sightings, _wires(frames.known, settings), settings.noise)


def others(known: PlusPhantom) -> Iterator[tuple[str, PlusPhantom]]:
    """The same wires strung or defined otherwise, in words."""
    rows = range(len(known.wires.ends))
    several = [(f"the diagonal of N-wire {row + 1}", [row]) for row in rows if len(rows) > 1]
    for which, restrung in [*several, ("all diagonals, as of a left-handed frame", [*rows])]:
        yield f"front and back exchanged of {which}", replace(known, wires=known.wires.restrung(restrung))


def calibrate(frames: PhantomFrames, settings: Settings, expected: Array) -> LineAdjustment:
    """Calibrate by all dots; an earlier calibration beside the wires is taken for the design."""
    known: PlusPhantom = frames.known
    earlier = known.target_from_pixel
    if earlier is not None:
        expected = line_calibration.pose_of(earlier)[0]
    return line_calibration.calibrate(
        frames.sightings,
        _wires(known, settings),
        frames.size,
        settings.noise,
        expected,
        settings.seed,
        settings.max_sigma_mm,
        frames.numbers[frames.usable],
        earlier,
    )


def figures(found: LineAdjustment) -> Metrics:
    """Places of the wires and the phantom, agreement of frames that weren't used, and what may be mistaken."""
    return {
        "dots_left_out": int((~found.inliers).sum()),
        "held_out_rms_mm": found.held_out_mm,
        "earlier_held_out_rms_mm": found.earlier_held_out_mm,
        "wires_beside_mm": float(np.linalg.norm(found.beside_mm, axis=1).max()),
        "registration_off_mm": found.registration_off[1],
        "registration_off_deg": found.registration_off[0],
        "phantom_size": found.size[0],
        "phantom_size_sigma": found.size[1],
        "frames_that_count_as_one": found.persistence,
        **lateness.figures(found.late),
    }


def describe(found: LineAdjustment, settings: Settings) -> Iterator[str]:
    """The held-out error beside that of an earlier calibration, and all that may be mistaken."""
    del settings
    earlier = found.earlier_held_out_mm
    transforms = "ImageToProbe" + ("" if found.wires.registration is None else " and the registration")
    beside = "" if np.isnan(earlier) else f"; {earlier:.3f} mm by {transforms} of wires="
    yield f"held out    {found.held_out_mm:.3f} mm (RMS of dots, odd frames by even ones and back){beside}"
    farthest = int(np.linalg.norm(found.beside_mm, axis=1).argmax())
    away = np.linalg.norm(found.beside_mm[farthest])
    left_out = f"; {(~found.inliers).sum()} dots left out" if not found.inliers.all() else ""
    yield f"wires       up to {away:.2f} mm from their places, {found.wires.phantom.names[farthest]}{left_out}"
    yield from (f"warning     {doubt}" for doubt in found.doubts())
