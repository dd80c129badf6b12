"""A session of a rig, rehearsed in the twin: the probe calibrated by crossed wires, and masses swept, from rendered images.

Frames and B-scans are those of the rig, and all that follows them is the real software. So the rehearsal has the noise of this
rig's own sensors, lenses, light and beam, and loses the images that it would lose; no size of noise is taken over from another
rig.

The repeatability CR1 of five calibrations of a dozen images scatters itself by 15 % and more, and their covariances don't tell
it: these hold what may have moved, and here nothing did; nor do errors drawn at other poses, as much of an error belongs to its
pose. So calibrations are mixed: frames of all of them, in the order of the image's corners that one of them has, each mixture
calibrated by the real software.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture.images import write_images
from recon.capture.manifest import image_name
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.freehand import scans as freehand_scans
from recon.geometry import rigid
from recon.geometry.order_statistics import NORMAL_MAD
from recon.model.calibration import Calibration
from recon.model.probe import ProbeCalibration
from recon.model.rig import Probe
from recon.model.tracks import Track
from recon.probe_calibration import cross_wire, point_calibration, repeatability, sound_in_water
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.point_calibration import Sightings
from recon.probe_calibration.tank_calibration import Result
from recon.probe_calibration.tank_calibration import Settings as Tank
from recon.session import masses_step, probe_step
from recon.session.masses_step import Method
from recon.tracking import networks, results
from recon.tracking.tracker import Tracker, Tracking
from scenes.acoustics import TISSUES, WATER_C
from twin.evaluation import sweep_errors
from twin.experiments.drawn_session import Noise, pair
from twin.experiments.experiment_runs import Settings
from twin.experiments.tube_accuracy import WATER
from twin.filmed_sweep import PlannedSweep, SweepSettings, plan_sweep
from twin.optics.surface_session import calibration_of
from twin.shooting import FilmQuality, FrameShooting
from twin.ultrasound import sweep_session
from twin.ultrasound.probe_path import SurfacePath, crossing
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.timed_sweep import Clocks, Plan
from twin.ultrasound.transducer import Transducer
from twin.working_range import working_range

if TYPE_CHECKING:
    from twin.tracking.rendered_views import Frames

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

IMAGES = 12  # B-scans of a calibration: the first ones in which the crossing shows, of
POSES = 60  # poses, which go on where those of the one before ended
MIXTURES = 60  # of calibrations, for CR1
FEW, SETS = 5, 400  # calibrations that a laboratory compares, and sets of as many, for the scatter of their CR1
REST_S = 0.2  # in each pose: two pairs of frames, between which the B-scan is taken
AT_REST = Clocks(camera_hz=5.0)
QUALITY = FilmQuality(
    rim=128
)  # rays a pixel: 16 leave 0.014 px of noise in circles' centres where sensors leave 0.002, 512 leave 0.005
PLACES = (-14.0, -14.0, 26.0), (-14.0, 0.0, 29.0), (-14.0, 14.0, 26.0)  # mm in the phantom
MASSES = {  # of silicone, with masses of 8 mm in a row under a stroke
    "kind": "breast",
    "edge_mm": 1.5,
    "tissue_mm": 2.0,
    "tumours": [{"size_mm": 8.0, "centre_mm": place} for place in PLACES],
}
STROKE = SurfacePath(start_mm=(-10.0, -29.0), end_mm=(-10.0, 25.0), speed_mm_s=12.0)
SWEPT = Clocks(camera_hz=10.0)
TISSUE_M_S = TISSUES["silicone"].speed
TANK = Tank(temperature_c=WATER_C, wire_radius_sigma_mm=0.0)
IN_WATER = WATER.model_dump(include={"tgc_db_per_cm_mhz", "gain_db"})  # as a scanner is set for wires, which saturate else


@dataclass(frozen=True)
class Stage:
    """A rig and its scanner as they are, of `settings`, and as they are known."""

    settings: Settings
    known: Calibration  # of the devices, by which frames are read
    dynamic_range_db: float  # of the scanner, by which B-scans are read
    seed: int


class Seen(NamedTuple):
    """Errors of what detectors find, against the twin's truth: standard deviations along each axis, by their medians."""

    circle_px: float  # of a circle of the target
    crossing_px: float  # of the wires' crossing
    shown: float  # share of poses about the wires in which a B-scan shows the crossing
    tracked: float  # share of those in which the target is tracked, too


class Wires(NamedTuple):
    """Calibrations of the probe by crossed wires."""

    results: tuple[Result, ...]
    seen: Seen
    sightings: tuple[Sightings, ...]  # of each


class Repeatability(NamedTuple):
    """CR1 of calibrations, mean of five points."""

    mm: float
    of_few: float  # relative standard deviation of the CR1 of FEW calibrations
    known: float  # relative standard deviation of the first, at most, as so few calibrations were rehearsed


class MassErrors(NamedTuple):
    """Errors of m masses; NaN of those that weren't found."""

    centre_mm: Array  # (m, 3) in the world
    volume: Array  # (m,) relative


class Rehearsed(NamedTuple):
    """What a rig finds of itself."""

    wires: Wires
    repeatability: Repeatability
    place_mm: float  # RMS error of the place of the image's middle against the target, by one calibration
    masses: MassErrors  # by their segmentation alone


def joined(found: Sequence[MassErrors]) -> MassErrors:
    """The masses of several sweeps."""
    return MassErrors(np.concatenate([one.centre_mm for one in found]), np.concatenate([one.volume for one in found]))


def of_itself(settings: Settings, seed: int) -> Stage:
    """A rig that is known exactly: where its twin rehearses."""
    return Stage(settings, calibration_of(settings.rig), settings.ultrasound.dynamic_range_db, seed)


def calibrate(stage: Stage, count: int) -> Wires:
    """Calibrate the probe some times, each by other B-scans, in poses in which the crossing shows.

    Raises
    ------
    InputError
        If a calibration is refused, such as where too few B-scans show the crossing.
    """
    tank = TANK.model_copy(update={"appearance": Appearance(stage.dynamic_range_db)})
    found, circles, crossings, counts = list[Result](), list[Array](), list[Array](), list[tuple[int, int, int]]()
    sightings = list[Sightings]()
    for number in range(count):
        planned, images, looked_at = showing(wires(stage, number), tank.appearance)
        with TemporaryDirectory() as folder:
            track, errors = tracked(stage, planned)
            frames = probe_step.look(recorded(planned, images, track, Path(folder)), tank, AT_REST.lag_s)
        result = probe_step.calibrate(frames, stage.settings.rig.probe, tank).result
        found.append(result)
        sightings.append(frames.sightings)
        circles.append(errors)
        crossings.append(crossing_errors(planned, frames)[~result.adjustment.outliers])
        counts.append((looked_at, len(images), len(frames.usable)))
    poses, shown, usable = np.sum(counts, axis=0)
    circle_px, crossing_px = (of_one_axis(np.concatenate(errors)) for errors in (circles, crossings))
    return Wires(tuple(found), Seen(circle_px, crossing_px, float(shown / poses), float(usable / shown)), tuple(sightings))


def showing(planned: PlannedSweep, look: Appearance) -> tuple[PlannedSweep, list[Image], int]:
    """The first poses at rest whose B-scans show the crossing, and these, as a person looks for it; of so many poses.

    Raises
    ------
    InputError
        If too few do.
    """
    chosen, images, number = list[int](), list[Image](), -1
    for number, scan in enumerate(planned.scans()):
        if cross_wire.find(scan.image, look).found:
            chosen.append(number)
            images.append(scan.image)
        if len(images) == IMAGES:
            break
    if len(images) < point_calibration.MIN_FRAMES:
        expected = f"expected {point_calibration.MIN_FRAMES} B-scans or more that show the wires' crossing"
        raise InputError(
            f"rehearsals: {expected}, found {len(images)} in {number + 1} poses: image too narrow, or beam too thick"
        )
    return at_some(planned, chosen), images, number + 1


def at_some(planned: PlannedSweep, chosen: Sequence[int]) -> PlannedSweep:
    """Some of the poses at rest alone, with their pairs of frames."""
    plan, kept = planned.plan, np.array(chosen, int)
    truth = Track(plan.truth.times[kept], plan.truth.poses[kept])
    near = (np.abs(plan.target.times[:, None] - truth.times) <= REST_S / 2 * 1e9).any(axis=1)
    times, held = plan.target.times[near], plan.target.target_from_image[near]
    target = replace(plan.target, times=times, target_from_image=held)
    track = Track(plan.track.times[near], plan.track.poses[near])
    return replace(planned, plan=Plan(plan.times[kept], track, truth, target))


def of_one_axis(errors: Array) -> float:
    """Standard deviation, px, along an axis of errors : (n, 2), robust against the few that fingers cover in part."""
    away = np.abs(errors - np.median(errors, axis=0))
    return float(np.sqrt(np.mean((NORMAL_MAD * np.median(away, axis=0)) ** 2)))


def wires(stage: Stage, number: int) -> PlannedSweep:
    """The probe at rest in poses about crossed wires, in the middle of where the rig works."""
    settings, where = stage.settings, working_range(stage.settings.rig)
    path = settings.wire_path.model_copy(update={"count": POSES, "first": number * POSES, "rest_s": REST_S})
    scene = {"kind": "crosswire", "cross_mm": where.place(4.0, -2.0, 660.0), "bottom_mm": where.depth(740.0)}
    scanner = settings.ultrasound.model_copy(update=IN_WATER)
    return plan_sweep(_sweep(stage, f"wires{number}", scene, scanner, path, AT_REST))


def _sweep(stage: Stage, name: str, scene: dict, scanner: Transducer, path: AnyPath, clocks: Clocks) -> SweepSettings:
    settings = stage.settings
    return SweepSettings(
        rig=settings.rig,
        scene=scene,
        ultrasound=scanner,
        path=path,
        conditions=settings.conditions,
        clocks=clocks,
        name=name,
        filmed=True,
        frames=FrameShooting(white_dn=settings.film.white_dn, quality=QUALITY),
        seed=stage.seed,
    )


def tracked(stage: Stage, planned: PlannedSweep) -> tuple[Track, Array]:
    """Film a sweep and track it; with the errors : (n, 2) px of all circles in the frames."""
    rig, cameras = stage.settings.rig, pair(stage.known)
    tracker = Tracker(cameras, rig.target, networks.load(kind=rig.target.kind), optics=stage.known.uncertainty)
    film, steps, errors = planned.film(stage.settings.ranges), [], []
    for time, frames in zip(film.times.tolist(), film.frames(), strict=True):
        found = tracker.step(*frames.views, time * 1e-9)
        steps.append(results.kept(found, time))
        errors.append(circle_errors(found, frames, tracker))
    return results.track_of(steps), np.concatenate(errors)


def circle_errors(found: Tracking, frames: "Frames", tracker: Tracker) -> Array:
    """Errors : (n, 2) px of the circles that a pair shows; none of a pair without a pose."""
    if not found.found:
        return np.zeros((0, 2))
    seen = [view.outlines.sighting(camera).centres for view, camera in zip(found.views, tracker.cameras, strict=True)]
    errors = np.concatenate(seen) - np.concatenate([view.ellipses[:, :2] for view in frames.truth])
    return errors[np.isfinite(errors).all(axis=1)]


def recorded(planned: PlannedSweep, images: Iterable[Image], track: Track, folder: Path) -> SweepCapture:
    """B-scans of a sweep with a track of the target, as the software reads them."""
    settings, plan = planned.settings, planned.plan
    paths = tuple(folder / image_name(number) for number in range(len(plan.times)))
    for path, image in zip(paths, images, strict=True):
        write_images([path], image[None])
    return SweepCapture(settings.name, settings.ultrasound.image_size, paths, np.arange(len(paths)), plan.times, track)


def crossing_errors(planned: PlannedSweep, frames: PhantomFrames) -> Array:
    """Errors : (m, 2) px of the crossings in all usable B-scans."""
    scanner, scanned = planned.settings.ultrasound, planned.scanned
    scale = np.array(scanner.scale_mm_per_px) * [1.0, scanned.medium.speed / scanner.assumed_speed]
    places = np.stack([rigid.apply(rigid.invert(pose), crossing(scanned)) for pose in planned.plan.truth.poses])
    return frames.sightings.pixels - (places[:, :2] / scale)[frames.usable]


def rehearse(settings: Settings, calibrations: int, sweeps: int, seed: int) -> Rehearsed:
    """What a rig finds in two calibrations of its probe or more, and sweeps over masses.

    Raises
    ------
    InputError
        As `calibrate` does.
    """
    stage = of_itself(settings, seed)
    found, probe = calibrate(stage, calibrations), settings.rig.probe
    mixed = mixtures(found.sightings, probe)
    of_probe = repeatability_of(mixed, calibrations, probe.image_size)
    swept = joined([segmented_exactly(stage, number) for number in range(sweeps)])
    return Rehearsed(found, of_probe, place_error(stage, mixed), swept)


def noise_of(settings: Settings, found: Wires) -> Noise:
    """The noise of drawn sessions of a rig, with that which its detectors have in a rehearsal."""
    seen, usual = found.seen, settings.noise.at(working_range(settings.rig))
    wires = max(round(seen.tracked * IMAGES), point_calibration.MIN_FRAMES)
    return usual.model_copy(update={"circle_px": seen.circle_px, "crossing_px": seen.crossing_px, "wires": wires})


def mixtures(found: Sequence[Sightings], design: Probe, seed: int = 0) -> list[ProbeCalibration]:
    """Calibrations by frames of n calibrations, each frame once at most; those that are refused are left out.

    The crossing of each mixture goes from corner to corner of the image as in one of the calibrations, at random: frames from
    anywhere would leave some corner empty, and in another order an error of a corner could look like a movement.
    """
    rng, mixed, frames = np.random.default_rng(seed), list[ProbeCalibration](), point_calibration.joined(found)
    middle = (np.array(design.image_size) - 1) / 2
    quarters = [(one.pixels > middle) @ [1, 2] for one in found]
    there = [np.flatnonzero(np.concatenate(quarters) == quarter) for quarter in range(4)]
    for _ in range(MIXTURES):
        visited = quarters[rng.integers(len(found))]
        chosen = np.empty(len(visited), int)
        for quarter, some in enumerate(there):
            chosen[visited == quarter] = rng.permutation(some)[: (visited == quarter).sum()]
        with suppress(InputError):
            adjusted = point_calibration.calibrate(
                frames.of(chosen), design.image_size, expected=design.target_from_image.matrix(), ahead_mm=TANK.echo_ahead_mm
            )
            mixed.append(adjusted.calibration)
    return mixed


def repeatability_of(mixed: Sequence[ProbeCalibration], count: int, size: tuple[int, int]) -> Repeatability:
    """CR1 of mixtures of so many calibrations, two of which share a part 1 / count of their frames in the mean.

    Variances of differences are so (1 - 1 / count) of those of calibrations by frames of their own. Mixtures tell CR1 as well as
    these calibrations themselves do, or better.

    Raises
    ------
    InputError
        If most mixtures are refused.
    """
    if len(mixed) < MIXTURES // 2:
        raise InputError(f"rehearsals: expected mixtures of calibrations that succeed, found {len(mixed)} of {MIXTURES} that do")
    rng = np.random.default_rng(0)
    few = [cr1([mixed[k] for k in rng.permutation(len(mixed))[:FEW]], size) for _ in range(SETS)]
    of_few = float(np.std(few) / np.mean(few))
    known = of_few * float(np.sqrt((FEW - 1) / (count - 1)))
    return Repeatability(cr1(mixed, size) / float(np.sqrt(1 - 1 / count)), of_few, known)


def place_error(stage: Stage, mixed: Sequence[ProbeCalibration]) -> float:
    """RMS error, mm, of the place of the image's middle in water against the target, by calibrations."""
    rig, scanner = stage.settings.rig, sweep_session.calibration_of(stage.settings.rig, stage.settings.ultrasound)
    truth = sound_in_water.in_medium(scanner, scanner.speed_m_s, float(sound_in_water.speed_of_sound(WATER_C)))
    middle = repeatability.five_points(rig.probe.image_size)[:1]
    return float(np.sqrt(np.mean([((one.to_target(middle) - truth.to_target(middle)) ** 2).sum() for one in mixed])))


def cr1(calibrations: Sequence[ProbeCalibration], size: tuple[int, int]) -> float:
    """CR1, mm, mean of five points."""
    return float(repeatability.cr1(calibrations, repeatability.five_points(size)).mean())


def masses(stage: Stage, number: int) -> PlannedSweep:
    """A stroke over masses in a row, of other forms for each number, in the same tissue."""
    scene = MASSES | {"seed": number}
    return plan_sweep(_sweep(stage, f"masses{number}", scene, stage.settings.ultrasound, STROKE, SWEPT))


def mass_errors(
    stage: Stage,
    planned: PlannedSweep,
    track: Track,
    probes: Sequence[ProbeCalibration],
    tissue_m_s: float = TISSUE_M_S,
    skin: trimesh.Trimesh | None = None,
) -> MassErrors:
    """Segment a sweep by each of some calibrations, told a speed of sound in the tissue, and the skin if given, and compare."""
    found, method = list[MassErrors](), Method(dynamic_range_db=stage.dynamic_range_db, overlays=0)
    with TemporaryDirectory() as folder:
        sweep = recorded(planned, (scan.image for scan in planned.scans()), track, Path(folder))
        for probe in probes:
            scans = freehand_scans.of_sweep(sweep, probe, planned.settings.clocks.lag_s, tissue_m_s)
            meshes = masses_step.find(freehand_scans.in_memory(scans), method, skin).meshes
            pairs = sweep_errors.compare(list(meshes.values()), [thing for thing in planned.scene.things if thing.inside])
            none = np.full(3, np.nan)
            centres = [none if one.found is None else one.found.center_mass - one.true.center_mass for one in pairs]
            volumes = [np.nan if one.found is None else one.found.volume / one.true.volume - 1 for one in pairs]
            found.append(MassErrors(np.array(centres), np.array(volumes)))
    return joined(found)


def segmented_exactly(stage: Stage, number: int) -> MassErrors:
    """Errors of masses by their segmentation alone: poses and probe are known."""
    planned = masses(stage, number)
    target = planned.plan.target
    probe = sweep_session.calibration_of(stage.settings.rig, stage.settings.ultrasound)
    return mass_errors(stage, planned, Track(target.times, target.poses()), [probe])


def segmented(stage: Stage, number: int, probes: Sequence[ProbeCalibration]) -> MassErrors:
    """Errors of masses in a sweep that is filmed and tracked, by each of some calibrations of the probe."""
    planned = masses(stage, number)
    return mass_errors(stage, planned, tracked(stage, planned)[0], probes)
