"""The sweep part of a session: B-scans along a path through a scene, image by image, and the truth about them."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.capture.images import write_images
from recon.capture.manifest import BODIES, SCANNER, Device, Purpose, image_name
from recon.capture.writer import CaptureWriter
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.rig import Rig
from recon.model.tracks import Track
from scenes.handheld.shaft import Shaft
from scenes.scene_types import Scene
from twin import conditions
from twin.session import Session, TruthFolder, describe
from twin.ultrasound import bscan_truth, scan_lines, tool_truth
from twin.ultrasound.bscan import Scan
from twin.ultrasound.echo_solids import Body, Solid, label_at
from twin.ultrasound.probe_path import (
    Bob,
    Hold,
    RowPath,
    SurfacePath,
    TiltPath,
    WirePath,
    about_crossing,
    along_surface,
    bobbing,
    over_rows,
    over_surface,
    resting,
)
from twin.ultrasound.timed_sweep import STILL, Clocks, Plan, PoseNoise, moments, plan
from twin.ultrasound.transducer import Transducer

AnyPath = Annotated[SurfacePath | Hold | Bob | WirePath | RowPath | TiltPath, Field(discriminator="kind")]

Array = NDArray[np.float64]

POSES = "sweep.npz"  # in the sweep's own folder of truth
GIVES_MM = 5.0  # by which a surface that keeps its form gives way to the probe, at most
LIVING = "living.npz"  # of a body that lives
LABELS = "labels"
SCANS = "scans"  # of further bodies at the moments of the images; at the cameras' in BODIES
PURPOSES: dict[str, Purpose] = {
    "wire": "probe",
    "rows": "probe",
    "tilts": "probe",
    "bob": "latency",
    "stroke": "volume",
    "hold": "volume",
}  # by the path's kind
SUPPORTS = ("table", "tank", "chest")  # what things lie on or in


def plan_sweep(
    path: AnyPath,
    rig: Rig,
    body: Body,
    transducer: Transducer,
    clocks: Clocks,
    noise: PoseNoise,
    seed: int,
    errors: conditions.Motion = STILL,
    carried: Callable[[NDArray[np.int64]], Array] | None = None,
    gives_mm: float = GIVES_MM,
) -> Plan:
    """Lead the probe along a path, and set the times of its images.

    Parameters
    ----------
    errors : of the hand, which trembles where it leads the probe, and of the bracket.
    carried : motion : (n, 4, 4) of the hand, by which it goes along with the body, at moments : (n,) ns.
    gives_mm : by which a surface gives way to the probe, at most

    Raises
    ------
    InputError
        If the scene hasn't what the path is about, the probe is led into something, or there are fewer than two images.
    """
    shaken = conditions.trembling(errors, seed)
    path_seed, clock_seed = np.random.SeedSequence(seed).generate_state(2).tolist()
    match path:
        case SurfacePath():
            course = along_surface(path, surface_of(path.surface, body), transducer, path_seed, shaken)
            taken = moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer, gives_mm)
        case Hold():
            course = resting(path, surface_of(path.surface, body), transducer, path_seed, shaken)
            taken = moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer, gives_mm)
        case Bob():
            course = bobbing(path, transducer, path_seed, shaken)
            taken = moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer)
        case WirePath():
            course, rests = about_crossing(path, body, transducer, path_seed)
            taken = rests if path.rest_s else moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer)
        case RowPath():
            course, rests = over_rows(path, body, transducer, path_seed)
            taken = rests if path.rest_s else moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer)
        case TiltPath():
            course, rests = over_surface(path, body, transducer, path_seed)
            taken = rests if path.rest_s else moments(course, clocks.scanner_hz)
            refuse_inside(course, body, transducer)
    if carried is not None:
        course = replace(course, poses=carried(course.times) @ course.poses)
    return plan(rig.probe, course, taken, clocks, noise, clock_seed, errors)


def surface_of(name: str, body: Body) -> Solid:
    """The solid of a name; of none the largest that is no support.

    Raises
    ------
    InputError
        If there is no such solid.
    """
    named = {solid.name: solid for solid in body.solids if not solid.is_layer}
    if name in named:
        return named[name]
    others = [solid for name, solid in named.items() if name not in SUPPORTS]
    if not named:
        raise InputError("path.surface: expected a scene of solid things, found one without")
    if name:
        raise InputError(f"path.surface: expected one of {', '.join(named)}, found {name}")
    if not others:
        raise InputError(
            f"path.surface: needs a value: the scene has no more than {', '.join(named)}; give path.surface={next(iter(named))}"
        )
    return others[0]


def refuse_inside(course: Track, body: Body, transducer: Transducer, allowed_mm: float = 0.0) -> None:
    """Refuse a course on which the array's face gets into a solid, by more than is allowed.

    Raises
    ------
    InputError
        If it does; the solid is named.
    """
    tables = body.packed()
    lines = scan_lines.lines_of(transducer)
    places = scan_lines.world_from_lines(
        lines, scan_lines.world_from_face(transducer, np.eye(4)), lines.middle_mm * np.linspace(0, 2, 5)
    )
    face = places[:, :3, 3] - allowed_mm * places[:, :3, 1]
    for time, pose in zip(course.times, course.poses, strict=True):
        found = max(label_at(tables, *point) for point in rigid.apply(pose, face))
        if found:
            name = body.solids[found - 1].name
            way = "; living=patient lets it yield" if body.grown is not None else ""
            expected = "in front of all things" if allowed_mm == 0 else f"no more than {allowed_mm:g} mm deep in a thing"
            raise InputError(f"path: expected the probe {expected}, found it in {name} after {time * 1e-9:.2f} s{way}")


def calibration_of(rig: Rig, transducer: Transducer) -> ProbeCalibration:
    """The rig's true probe calibration, right where sound travels as the scanner assumes."""
    scale = np.array(rig.probe.scale_mm_per_px)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), scale, speed_m_s=transducer.assumed_speed)


class FilmPart(Protocol):
    """Frames of both cameras, which see the target of a sweep."""

    @property
    def times(self) -> NDArray[np.int64]:
        """Of the pairs : (m,) ns."""
        ...

    @property
    def devices(self) -> dict[str, Device]:
        """Both cameras as they are set."""
        ...

    def images(self) -> Iterator[tuple[str, NDArray]]:
        """Render the images, each with its camera's name."""
        ...

    def finish(self, capture: CaptureWriter, truth: TruthFolder) -> None:
        """Write what else belongs to them."""
        ...


class TrackedBody(Protocol):
    """A body besides the probe in a sweep of n images."""

    @property
    def track(self) -> Track:
        """Poses `world_from_target` by the cameras, with their noise."""
        ...

    @property
    def truth(self) -> Track:
        """The same at the cameras' moments."""
        ...

    @property
    def scanned(self) -> Track:
        """Poses `reference_from_target` when the n images are taken, in the world as it was under the fringes."""
        ...

    @property
    def shaft(self) -> Shaft | None:
        """The shaft that sound meets, in the target's frame."""
        ...


def write_session(
    session: Session,
    scene: Scene,
    body: Body,
    transducer: Transducer,
    planned: Plan,
    scans: Iterable[Scan],
    probe: ProbeCalibration | None,
    film: FilmPart | None = None,
    bodies: Mapping[str, TrackedBody] = MappingProxyType({}),
    living: Callable[[], Mapping[str, Array]] | None = None,
    reference_from_image: Array | None = None,
) -> None:
    """Write a sweep and its truth, taking the scans one by one, and then the frames.

    Parameters
    ----------
    probe : of the capture; None where it is still to be calibrated.
    film : of the cameras, in which the poses are then still to be found; None where the poses are given.
    bodies : further ones, by name
    living : truth of a body that lives, asked for when all images are taken
    reference_from_image : (n, 4, 4) mm, where its images are in its own frame; else as in the world
    """
    with session.write(_describe_sound(scene, body)) as (capture, truth):
        own = truth.own.relative_to(truth.folder)
        truth.write_arrays(str(own / POSES), {"world_from_image": planned.truth.poses, "times_ns": planned.truth.times})

        met = planned.truth.poses if reference_from_image is None else reference_from_image
        shown: dict[str, list[dict[str, NDArray]]] = {one: [] for one in bodies}

        def images() -> Iterator[tuple[str, NDArray[np.uint8]]]:
            for number, one in enumerate(scans):
                for further, led in bodies.items():
                    if led.shaft is not None:
                        shaft, pose = led.shaft.moved(led.scanned.poses[number]), met[number]
                        shown[further].append(tool_truth.placed(shaft, transducer, one.paths, pose))
                labels = bscan_truth.labels(one.paths, transducer)
                write_images([truth.own / LABELS / image_name(number)], labels[None])
                yield SCANNER, one.image
            if film is not None:
                yield from film.images()

        times, devices = {SCANNER: planned.times}, {SCANNER: Device(size=transducer.image_size)}
        if film is not None:
            times |= dict.fromkeys(film.devices, film.times)
            devices |= film.devices
        name = session.part.partition("/")[2]
        track, tracks = (planned.track, {further: led.track for further, led in bodies.items()}) if film is None else (None, {})
        capture.add_sweep(times, images(), devices, track, name, session.purpose, tracks)
        if living is not None:
            truth.write_arrays(str(own / LIVING), living())
        for further, led in bodies.items():
            seen = {"times_ns": led.truth.times, "world_from_target": led.truth.poses}
            scanned = {"times_ns": led.scanned.times, "reference_from_target": led.scanned.poses}
            truth.write_arrays(str(own / BODIES / f"{further}.npz"), seen)
            placed = {key: np.array([each[key] for each in shown[further]]) for key in (shown[further] or [{}])[0]}
            truth.write_arrays(str(own / SCANS / f"{further}.npz"), scanned | placed)
        if film is not None:
            film.finish(capture, truth)
        if probe is not None:
            capture.add_probe(probe)


def _describe_sound(scene: Scene, body: Body) -> dict[str, object]:
    """A scene as the scanner shows it: the names of its labels, and the wires' ends."""
    labels = ["surroundings", *(solid.name for solid in body.solids)]
    wires = [{"name": wire.name, "ends_mm": wire.ends.tolist(), "radius_mm": wire.radius} for wire in body.wires]
    return describe(scene, labels=labels, wires=wires)
