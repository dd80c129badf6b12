"""Rigs drawn at random, their captures rendered, and the rigs identified from these, in units of what is said of their errors.

The rig's sheet, which identification begins with, has what is read off data sheets: sizes, pixels, nominal focal lengths, light.
The scanner's has its probe's label and the phantom's sheet, both with errors; all else of it is the usual scanner's.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.manifest import SCANNER, sweep_part
from recon.files.metrics import Metrics
from recon.identification.estimates import Findings
from recon.model.patterns import Axis, Fringes, GrayCode, Patterns
from recon.model.rig import Rig
from recon.optical_calibration.figures_of_merit import normalised_error
from recon.session import rig_step, scanner_step
from recon.session.rig_step import Identification
from scenes.acoustics import TISSUES
from scenes.board_poses import Config as BoardPoses
from scenes.catalogue import build_scene
from scenes.kinds import plane
from twin import board_session
from twin.conditions import Conditions, Frames
from twin.devices.still_scenes import even_radiance
from twin.experiments import drawn_rig, predicted_plane, surface_accuracy
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.predicted_plane import Measurement
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.optics import surface_session
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting
from twin.sensor import Exposure, expose
from twin.session import CAPTURE, Session
from twin.ultrasound.probe_path import Bob, Hand, SurfacePath
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer
from twin.working_range import working_range

Array = NDArray[np.float64]

SCENES = ("breast", "sphere", "two_objects")
TRACING = Tracing(samples=32, room_lux=20)  # more than usual: drawn cameras blur over several samples' distance
FRINGES_TRACING = {"cam1": Tracing(samples=128, room_lux=20), "cam2": TRACING}  # the projector is identified by camera 1, whose
# residuals 32 samples raise by 30 %, and z-scores of the projector's lens and gamma to 1.5
CAMERAS = board_session.CAMERAS
POSES = 10  # of the board
FRAMES = 16  # dark ones, and flat ones of each level
LEVELS = (0.3, 0.8)  # of full scale, of flat frames
PHANTOM = {  # even gelatin
    "kind": "test_object",
    "size_mm": (80.0, 160.0, 60.0),
    **dict.fromkeys(("filament_depths_mm", "row_x_mm", "cysts", "bright", "dark"), ()),
}
STILL = Hand(shift_mm=0.0, turn_deg=0.0)  # of a probe on a slide
SWEEPS = {  # of the scanner: each elsewhere in tissue; side by side; over water without an echo, as in air
    "tissue": (PHANTOM, SurfacePath(start_mm=(4.0, -68.0), end_mm=(4.0, 48.0), speed_mm_s=20.0), Clocks(scanner_hz=2.0)),
    "steps": (
        PHANTOM,
        SurfacePath(start_mm=(4.0, 58.0), end_mm=(4.0, 64.0), speed_mm_s=2.0, hand=STILL),
        Clocks(scanner_hz=10.0),
    ),
    "air": ({"kind": "tank"}, Bob(middle_mm=(4.0, -2.0, 600.0), seconds=0.3), Clocks()),
}
PLATE = plane.PAPER_POSES[2]  # a plane that is measured
SETTINGS = {"designed": (12, 0.9), "half_light": (12, 0.45), "fine_third_light": (8, 0.3)}  # pitches, and levels of light for it;
# fine fringes make up for less light if the projector is sharp
MIDDLE_PX = (192, 160)  # of camera 1's image: 30 000 points know their RMS to half a per cent
FINE_TRACING = Tracing(samples=2048, room_lux=20)  # for a plane: fewer leave noise of their own
LABEL, SHEET = 0.05, (0.03, 0.5)  # errors: of the label's frequency, relative; of the attenuation, dB/cm/MHz, and the echo, dB
NEUTRAL = {  # what is to be identified, as a sheet has it: ordinary values
    "lens": {"f_number": 8.0, "focus_mm": 660.0, "blur_px": 0.5, "vignetting": 0.1},
    "sensor": {"saturation_e": 8000.0, "dark_noise_e": 10.0, "dsnu_e": 5.0, "prnu": 0.008, "black_level_dn": 3.0},
    "projector": {"gamma": 2.2, "contrast": 1000.0},
}


def measure(settings: Settings, seed: int) -> Metrics:
    """Errors over sigmas of all numbers that were measured, how many 95 % intervals hold the truth, and a setting's choice.

    Numbers of the optics err together, and are judged together besides.
    """
    rig, conditions = drawn_rig.draw(settings.rig, seed)
    array = drawn_rig.draw_scanner(np.random.default_rng([seed, 61]))
    rig = with_scanner(rig, array)
    with TemporaryDirectory() as folder:
        identified, found = identify_recorded(rig, conditions, array, Path(folder), settings.poses.seed + seed, seed)[:2]
    judged = judge(found, truth_of(rig, conditions, array, found))
    judged["optics_error_over_sigma"] = normalised_error(identified.calibration(), rig.calibration())
    return judged | choose_setting(rig, identified, conditions, seed, frames_of(found))


def identify_recorded(
    rig: Rig, conditions: Conditions, array: Transducer, out: Path, poses_seed: int, seed: int
) -> Identification:
    """Record a rig's captures in a folder, and identify it from these and its sheet."""
    by_light = record_optics(rig, conditions, out, poses_seed, seed)
    record_sweeps(rig, array, out, seed)
    return rig_step.identify(rig_step.Settings(**by_light, **scanner_sheet(array, seed)))


def record_optics(rig: Rig, conditions: Conditions, out: Path, poses_seed: int, seed: int) -> dict[str, Any]:
    """Record a surface, a board and frames in a folder; returns the fields of their identification, by the rig's sheet."""
    exposures = record_surface(rig, conditions, out, seed)
    record_board(rig, conditions, out, poses_seed, seed)
    record_frames(rig, exposures, out, seed)
    frames = {"dark": out / "dark", "flat": out / "flat", "adc_bits": rig.cam1.sensor.adc_bits}
    return {"capture": out / CAPTURE, "rig": sheet_of(rig), **frames}


def with_scanner(rig: Rig, array: Transducer) -> Rig:
    """The rig with images of a scanner."""
    return scanner_step.with_image(rig, array.image_size, array.scale_mm_per_px, rig.probe.target_from_image)


def record_sweeps(rig: Rig, array: Transducer, out: Path, seed: int) -> None:
    """B-scans of even tissue, by a hand and on a slide, and in air."""
    for name, (scene, path, clocks) in SWEEPS.items():
        chosen = SweepSettings(rig=rig, scene=scene, ultrasound=array, path=path, clocks=clocks, name=name, seed=seed)
        planned = plan_sweep(chosen)
        planned.write(Session(out, sweep_part(name), {}, True, (SCANNER,), "volume"), planned.scans())


def scanner_sheet(array: Transducer, seed: int) -> dict[str, Any]:
    """Fields of a scanner's identification: the sweeps, and what labels and sheets say, with their errors."""
    errors = np.random.default_rng([seed, 62]).standard_normal(3)
    frequency = array.frequency_mhz * (1 + LABEL * float(errors[0]))
    return {
        **{name: name for name in SWEEPS},
        "ultrasound": Transducer(),
        "frequency_mhz": frequency,
        "frequency_sigma_mhz": LABEL * frequency,
        "attenuation_db_per_cm_mhz": TISSUES["gelatin"].attenuation + SHEET[0] * float(errors[1]),
        "attenuation_sigma": SHEET[0],
        "echo_db": SHEET[1] * float(errors[2]),
        "echo_sigma_db": SHEET[1],
    }


def patterns_of(rig: Rig) -> Patterns:
    """Fringes and a code along the columns, whose stripes have many widths."""
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=8, complementary=True))
    return Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=parts)


def board_patterns_of(rig: Rig) -> Patterns:
    """A code along both axes, to the pixel: no grey levels, whose shifts would err alike over a whole board."""
    size = rig.projector.optics.size
    axes: tuple[Axis, Axis] = ("columns", "rows")
    bits = [int(np.ceil(np.log2(length))) for length in size]
    parts = [GrayCode(axis=axis, pitch=1, bits=count, inverted=True) for axis, count in zip(axes, bits, strict=True)]
    return Patterns(projector_size=size, unwrap="gray", parts=tuple(parts))


def record_surface(rig: Rig, conditions: Conditions, out: Path, seed: int) -> dict[str, Exposure]:
    """A scene under fringes, before both cameras; returns their exposures."""
    scene, patterns = build_scene({"kind": SCENES[seed % len(SCENES)]}), patterns_of(rig)
    shot = partial(surface_session.shoot, rig, scene, patterns)
    views = {camera: shot(camera, FRINGES_TRACING[camera], Shooting(), seed, conditions) for camera in CAMERAS}
    session = Session(out, "surface", {}, True)
    surface_session.write_session(session, rig, rig, scene, patterns, views)
    return {camera: view.exposure for camera, view in views.items()}


def record_board(rig: Rig, conditions: Conditions, out: Path, poses_seed: int, seed: int) -> None:
    """The board in some poses."""
    work = working_range(rig)
    poses = work.poses(BoardPoses(count=POSES, seed=poses_seed))
    design = work.board(board_session.board.Config())
    chosen = board_session.Settings(
        rig, design, poses, board_patterns_of(rig), ("cam1", "cam2"), TRACING, Shooting(), seed, conditions
    )
    session, stage = Session(out, "board", {}, True), board_session.set_up(chosen)
    exposures, placed = board_session.set_exposures(stage, chosen), board_session.place_all(chosen)
    for number in board_session.missing_poses(session, chosen):
        board_session.write_pose(session, number, *board_session.shoot_pose(stage, chosen, exposures, number, placed[number]))
    board_session.finish(session, chosen, exposures, placed)


def record_frames(rig: Rig, exposures: Mapping[str, Exposure], out: Path, seed: int) -> None:
    """Dark frames, and flat ones of an even light that falls by a fifth towards a corner, exposed as the surface."""
    for number, name in enumerate(CAMERAS):
        device, exposure = getattr(rig, name), exposures[name]
        for place, level in {"dark": 0.0, **{f"flat/{{}}/{k}": level for k, level in enumerate(LEVELS)}}.items():
            radiance = even_radiance(rig, name, level, exposure.time_s)
            stack = np.broadcast_to(radiance, (FRAMES, *radiance.shape))
            images = expose(stack, device, rig.projector.wavelength_nm, exposure, seed + number + round(100 * level))
            folder = out / (place.format(name) if "{}" in place else f"{place}/{name}")
            folder.mkdir(parents=True)
            for k, image in enumerate(images):
                cv2.imwrite(str(folder / f"{k:02d}.png"), image)


def sheet_of(rig: Rig) -> Rig:
    """What a data sheet says of a rig: ordinary values for what is to be identified."""
    changed = {}
    for name in ("cam1", "cam2"):
        device = getattr(rig, name)
        lens, sensor = (getattr(device, part).model_copy(update=NEUTRAL[part]) for part in ("lens", "sensor"))
        changed[name] = device.model_copy(update={"lens": lens, "sensor": sensor})
    lens = rig.projector.lens.model_copy(update={"f_number": 2.4, "focus_mm": 660.0, "blur_px": 0.5, "vignetting": 0.15})
    changed["projector"] = rig.projector.model_copy(update={"lens": lens, **NEUTRAL["projector"]})
    return rig.model_copy(update=changed)


def truth_of(rig: Rig, conditions: Conditions, array: Transducer, found: Findings) -> dict[str, float]:
    """True values of what was measured, as far as the twin has them."""
    truth, clocks = dict[str, float](), SWEEPS["steps"][2]
    for name in found.estimates:
        group, _, rest = name.partition(".")
        if group == "conditions":
            part, field = rest.split(".")
            truth[name] = float(getattr(getattr(conditions, part), field))
        elif group == "ultrasound":
            field, _, place = rest.partition(".")
            truth[name] = float(getattr(array, field)[int(place)] if place else getattr(array, field))
        elif group == "clocks":
            truth[name] = float(getattr(clocks, rest))
        elif group in Rig.model_fields:
            truth[name] = 0.0 if _is_further_term(name, rig) else rig.number(name)
    return truth


def _is_further_term(name: str, rig: Rig) -> bool:
    """Whether a number is a term of a richer distortion than the rig's, which has none of it."""
    device, found, term = name.partition(".optics.distortion.")
    return bool(found) and int(term) >= len(getattr(rig, device).optics.distortion)


def frames_of(found: Findings) -> Frames:
    """Errors of frames as identified; none of what is unknown."""
    group = "conditions.frames."
    return Frames(**{name.removeprefix(group): one.value for name, one in found.estimates.items() if name.startswith(group)})


def choose_setting(rig: Rig, identified: Rig, conditions: Conditions, seed: int, frames: Frames) -> Metrics:
    """Errors of a plane with each setting, as predicted of the identified rig, over those that are found; and their ranking.

    frames : their errors as identified; the sheet says nothing of them

    The true rig records the plane, and points are by the identified one's calibration, in the middle of camera 1's image.
    Settings are ranked if they come in the order of what is found; likewise by predictions of the sheet.
    """
    true, known, sheet = (middle_of(one) for one in (rig, identified, sheet_of(rig)))
    found, by_twin, by_sheet = np.empty((3, len(SETTINGS)))  # mm
    for k, (pitch, level) in enumerate(SETTINGS.values()):
        parts = (Fringes(pitch=pitch, steps=8), GrayCode(pitch=pitch, bits=8, complementary=True))
        patterns = Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=parts)
        chosen = Measurement(patterns, PLATE, Shooting(level=level), FINE_TRACING)
        seen = surface_accuracy.experiment(
            true, plane.build(PLATE), patterns, seed, chosen.tracing, chosen.shooting, conditions, known
        )
        found[k] = seen.metrics["plane_plate_rms_mm"]
        by_twin[k] = predicted_plane.predict(known, replace(chosen, frames=frames)).rms_mm
        by_sheet[k] = predicted_plane.predict(sheet, chosen).rms_mm
    figures: Metrics = {}
    for k, name in enumerate(SETTINGS):
        figures |= {f"{name}_found_mm": float(found[k]), f"{name}_predicted_over_found": float(by_twin[k] / found[k])}
        figures[f"{name}_sheet_over_found"] = float(by_sheet[k] / found[k])
    order, by_twin_order, by_sheet_order = (np.argsort(row).tolist() for row in (found, by_twin, by_sheet))
    return figures | {"ranked": int(by_twin_order == order), "ranked_by_sheet": int(by_sheet_order == order)}


def middle_of(rig: Rig) -> Rig:
    """The rig with the middle of camera 1's image alone, which takes fewer rays."""
    optics, lens = rig.cam1.optics, rig.cam1.lens
    cut = (np.array(optics.size) - MIDDLE_PX) // 2
    size = np.array(optics.size) - 2 * cut
    smaller = optics.model_copy(update={"size": tuple(size.tolist()), "centre_px": tuple((optics.centre_px - cut).tolist())})
    share = np.sum((size - 1.0) ** 2) / np.sum((np.array(optics.size) - 1.0) ** 2)  # of the corner's distance, squared
    darkened = lens.model_copy(update={"vignetting": lens.vignetting * float(share)})
    return rig.model_copy(update={"cam1": rig.cam1.model_copy(update={"optics": smaller, "lens": darkened})})


def judge(found: Findings, truth: Mapping[str, float]) -> Metrics:
    """Errors over sigmas by name, and the share of those within 1.96."""
    off = {name: (found.estimates[name].value - true) / found.estimates[name].sigma for name, true in truth.items()}
    inside = np.abs(list(off.values())) < 1.96
    figures: Metrics = {"measured": len(off), "held": int(inside.sum()), "held_share": float(inside.mean())}
    return figures | {f"{name.replace('.', '_')}_over_sigma": float(value) for name, value in off.items()}


SHOWN = ("held_share", "optics_error_over_sigma", *(f"{name}_predicted_over_found" for name in SETTINGS))
COUNTS = ("measured", "held", "ranked", "ranked_by_sheet")
EXPERIMENT = Experiment(("rig", "poses"), measure, dict.fromkeys(SHOWN, ""), counts=COUNTS)
