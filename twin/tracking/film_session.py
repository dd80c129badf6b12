"""Films: a hand leads the target along a smooth path before both cameras, frame by frame, with the truth of each.

One probe, one surroundings, one light and one exposure for all frames, all from a seed. Over an exposure the target moves evenly,
by the path's own derivative in the middle of it. Further bodies of the rig follow paths of their own beside the probe's.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.capture.manifest import CAMERAS, Device
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.circle_layout import circle_centres
from recon.model.rig import PROBE, Positive, Rig, Target
from scenes.handheld.body_look import Stand
from scenes.handheld.handheld_assembly import held
from scenes.handheld.mesh_parts import Part
from scenes.handheld.surroundings import surroundings
from scenes.scene_types import Scene
from twin import conditions
from twin.session import Session, describe
from twin.shooting import FilmQuality, Quality, Shooting
from twin.tracking.film_path import STILL, FilmPath, Way
from twin.tracking.film_paths import insertion
from twin.tracking.led_bodies import LedBodies
from twin.tracking.mesh_bank import Bank, bank_of, build_bank, reshape_scene, uncovered, uncovered_share
from twin.tracking.rendered_views import Frames, Views, render_film, render_full, render_still, white_radiance
from twin.tracking.samples import Held, Motion, Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.study_samples import CLEAN

Array = NDArray[np.float64]

TRUTH = "film.npz"  # of the probe, in the sweep's own folder of truth; see `truth_name`
BODIES = 4  # of which the one is taken whose fingers and cable cover least of the circles
LOOKS = 8  # frames in which that is looked at
NEAREST_MM = 100.0  # of a circle before a camera, along its axis
BATCH = 6  # frames traced in one launch; doesn't change them
FAR_LAMPS_MM = (1000.0, 2500.0)  # that all bodies are about as bright
TABLE_MM = 40.0  # a needle's tip may reach past the probe's path: what surrounds begins 60 mm behind that

Seen = Mapping[str, Views]  # truth of a pair by bodies' names


class Filming(Shooting, LedBodies):
    """Settings of a film."""

    frames: Annotated[int, Field(ge=1, le=100_000)] = 30
    camera_hz: Positive = 30.0
    path: FilmPath

    @model_validator(mode="after")
    def _one_after_the_other(self) -> "Filming":
        if self.exposure_s * self.camera_hz > 1:
            raise ValueError(f"exposure_s: expected at most 1 / camera_hz = {1 / self.camera_hz:.4g}, found {self.exposure_s:g}")
        return self

    @model_validator(mode="after")
    def _without_b_scans(self) -> "Filming":
        for name, body in self.bodies.items():
            if isinstance(body.path, insertion.Kind) and (body.path.aim_mm is None or body.path.entry_mm is None):
                raise ValueError(
                    f"bodies.{name}.path.kind: expected another than insertion, as a film has no B-scan to lead it to: "
                    "give aim_mm and entry_mm in the world, or render it by sonotwin sweep filmed=true"
                )
        return self

    @property
    def times(self) -> NDArray[np.int64]:
        """Middles of the exposures : (n,) ns."""
        return np.rint(np.arange(self.frames) * 1e9 / self.camera_hz).astype(np.int64)


@dataclass(frozen=True)
class Stage:
    """A film before its bodies are built: what is drawn once, set up about the paths, and the ways of all bodies by name."""

    drawn: Take
    ways: Mapping[str, Way]

    def motions(self, filming: Filming) -> dict[str, list[Motion]]:
        """Of each body over all exposures."""
        times = (filming.times * 1e-9).tolist()
        return {name: [way.motion(time, filming.exposure_s) for time in times] for name, way in self.ways.items()}

    def stand(self, name: str) -> Stand:
        """Where a body stands when the film begins, from its target; an arm leads away from the middle of all."""
        way, into_scene = self.ways[name], self.drawn.scene_from_world
        pose = way.pose(0.0)
        into = rigid.invert(pose)
        eyes = np.array([device.optics.camera().centre for device in self.drawn.cameras])
        height = float(rigid.apply(into_scene, way.middle(0.0))[2])
        outwards = way.middle(0.0) - np.mean([other.middle(0.0) for other in self.ways.values()], axis=0)
        away = rigid.rotate(into, outwards - [0, 0, outwards[2]])
        return Stand(rigid.apply(into, eyes), rigid.rotate(into, into_scene[2, :3]), height, away / np.linalg.norm(away))


def set_stage(rig: Rig, ranges: DataRanges, filming: Filming, seed: int, errors: conditions.Motion = STILL) -> Stage:
    """Draw what a film has once, as for a data set's sample, and lead all bodies.

    Raises
    ------
    InputError
        If a body has no path, or a path leads too near to a camera.
    """
    light = ranges.light.model_copy(update={"projector_share": 0.0} | ({"lamp_mm": FAR_LAMPS_MM} if rig.bodies else {}))
    drawn = draw(ranges.model_copy(update={"variants": BODIES, "light": light}), rig, seed, 0)
    cameras = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    eyes = (cameras[0].centre + cameras[1].centre) / 2
    ways, farthest = {PROBE: filming.path.lead(rig.target, eyes, seed, errors)}, filming.path.room_mm
    width_mm = rig.probe.scale_mm_per_px[0] * (rig.probe.image_size[0] - 1)
    face = ways[PROBE].pose(0.0) @ rig.probe.target_from_image.matrix() @ rigid.transform(np.eye(3), [width_mm / 2, 0, 0])
    for number, (name, target) in enumerate(rig.bodies.items()):
        look, path = filming.look(name), filming.path_of(name, number)
        ways[name] = filming.lead(name, path, rig, face, seed, errors)
        tip = look.tip_mm(target)
        reach = 0.0 if tip is None else rigid.apply(ways[name].pose(0.0), tip)[2] - TABLE_MM
        farthest[2] = max(farthest[2], path.room_mm[2], reach)
    moved = farthest - drawn.motion.world_from_target[:3, 3]
    lamps = drawn.lighting.lamps.copy()
    lamps[:, :3] += moved
    scene = drawn.scene_from_world @ rigid.transform(np.eye(3), -moved)
    lighting = replace(drawn.lighting, lamps=lamps)
    same = replace(drawn, cameras=(rig.cam1, rig.cam2), present=True, lighting=lighting, scene_from_world=scene)
    return Stage(same, ways)


def make_bank(rig: Rig, ranges: DataRanges, filming: Filming, seed: int) -> Bank:
    """The bodies and surroundings that a film is chosen from: variants of the probe, then each further body as it looks."""
    if not rig.bodies:
        return build_bank(rig.target, BODIES, seed)
    stage = set_stage(rig, ranges, filming, seed)
    streams = [np.random.default_rng([seed, 1 << 32, kind]) for kind in range(2 + len(rig.bodies))]
    bodies = [held(streams[0], rig.target) for _ in range(BODIES)]
    bodies += [
        filming.look(name).parts(stream, target, stage.stand(name))
        for stream, (name, target) in zip(streams[2:], rig.bodies.items(), strict=True)
    ]
    return bank_of(bodies, [surroundings(streams[1]) for _ in range(BODIES)])


def takes(bank: Bank, rig: Rig, ranges: DataRanges, filming: Filming, seed: int, errors: conditions.Motion = STILL) -> list[Take]:
    """Parameters of each frame: all is drawn once, as for a data set's sample, but the poses, the motions and the noise."""
    stage = set_stage(rig, ranges, filming, seed, errors)
    motions = stage.motions(filming)
    cameras = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    for name, own in motions.items():
        places = np.array([rigid.apply(motion.world_from_target, circle_centres(rig.targets[name])) for motion in own])
        if min(rigid.apply(camera.camera_from_world, places)[..., 2].min() for camera in cameras) < NEAREST_MM:
            field = "path" if name == PROBE else f"bodies.{name}.path"
            raise InputError(f"{field}: expected places at least {NEAREST_MM:g} mm before both cameras, found nearer ones")
    led = motions.pop(PROBE)
    face = replace(CLEAN, ink=stage.drawn.face.ink, paper=stage.drawn.face.paper)  # of the same printer as the probe's
    lines = {name: filming.look(name).line_mm(rig.targets[name]) for name in motions}
    others = [
        {name: Held(own[k], BODIES + number, face, line=lines[name]) for number, (name, own) in enumerate(motions.items())}
        for k in range(len(led))
    ]
    centres = np.array([camera.centre for camera in cameras])
    looked = np.linspace(0, len(led) - 1, min(LOOKS, len(led))).astype(int)
    if others[0]:
        some = [replace(stage.drawn, motion=led[k], others=others[k]) for k in looked]
        shares = [
            np.mean([uncovered_share(bank, replace(take, body=body), rig.targets, centres) for take in some])
            for body in range(BODIES)
        ]
    else:
        eyes = np.array([rigid.apply(rigid.invert(led[k].world_from_target), centre) for k in looked for centre in centres])
        shares = [uncovered(bank, body, rig.target, eyes) for body in range(BODIES)]
    made = in_a_row(replace(stage.drawn, body=int(np.argmax(shares))), led, rig, filming, seed, errors)
    return [replace(take, others=its) for take, its in zip(made, others, strict=True)]


def in_a_row(
    same: Take, motions: Sequence[Motion], rig: Rig, shooting: Shooting, seed: int, errors: conditions.Motion = STILL
) -> list[Take]:
    """Takes that differ by motion and noise alone, under one exposure: as bright on the whole as asked for, and in each frame as
    the light falls.
    """
    noise = np.random.default_rng([seed, 3]).integers(2**31, size=len(motions)).tolist()
    late = conditions.triggered(errors, len(motions), seed) / shooting.exposure_s
    made = [
        replace(same, k=k, motion=motion, noise_seed=noise[k], late=tuple(late[k].tolist()), gain=shooting.gain)
        for k, motion in enumerate(motions)
    ]
    falls = np.array([white_radiance(take, rig) for take in made])
    return [
        replace(take, white_dn=shooting.white_dn * part) for take, part in zip(made, (falls / falls.mean()).tolist(), strict=True)
    ]


def shoot_moving(
    bank: Bank, rig: Rig, made: Sequence[Take], quality: FilmQuality, seed: int, moments: Iterable[Sequence[Part]]
) -> Iterator[Frames]:
    """Render the frames one after the other, of surroundings whose parts move: as they are in each."""
    for take, parts in zip(made, moments, strict=True):
        reshape_scene(bank, parts)
        yield from render_film(bank, rig, [take], quality, seed, render_still(bank, rig, take, quality, seed))


def shoot(
    bank: Bank, rig: Rig, made: Sequence[Take], quality: FilmQuality, seed: int, pixels: Literal["sketch", "full"] = "sketch"
) -> Iterator[Frames]:
    """Render the frames one after the other."""
    still = render_still(bank, rig, made[0], quality, seed) if pixels == "sketch" else None
    for first in range(0, len(made), BATCH):
        some = made[first : first + BATCH]
        if still:
            yield from render_film(bank, rig, some, quality, seed, still)
        else:
            yield from render_full(bank, rig, some, Quality(window=quality.rim), seed)


def write_session(
    session: Session, rig: Rig, calibrated: Rig, filming: Filming, made: Sequence[Take], frames: Iterable[Frames]
) -> None:
    """Write a film, which is a sweep without B-scans, and its truth, taking the frames one by one.

    rig, calibrated : as it took the frames, and as it was when it was calibrated.

    A calibration that has been measured for a capture that is added to stays in it.
    """
    with session.write(describe(Scene("film", ()), labels=[])) as (capture, truth):
        truth.write_optics(cameras_of(rig))
        seen: list[Seen] = []
        capture.complete_calibration(cameras_of(calibrated))
        capture.add_sweep(
            dict.fromkeys(CAMERAS, filming.times),
            images(frames, seen),
            devices(rig, filming),
            name=session.part.partition("/")[2],
        )
        for name in made[0].held:
            arrays = truth_arrays(filming.times, made, seen, name)
            truth.write_arrays(f"{session.part}/{truth_name(name)}", {**arrays, **_tip(filming, name, rig.targets[name])})


def _tip(filming: Filming, body: str, target: Target) -> Mapping[str, Array]:
    """The tip of a body, by its path or its look, in the target's frame; nothing where it has none."""
    if body == PROBE:
        return filming.path.truth(target)
    tip = filming.look(body).tip_mm(target)
    return {} if tip is None else {"tip_mm": tip}


def devices(rig: Rig, shooting: Shooting) -> dict[str, Device]:
    """Both cameras as they are set."""
    sizes = {name: getattr(rig, name).optics.size for name in CAMERAS}
    return {name: Device(size=size, exposure_s=shooting.exposure_s, gain=shooting.gain) for name, size in sizes.items()}


def images(frames: Iterable[Frames], seen: list[Seen]) -> Iterator[tuple[str, NDArray]]:
    """Images of both cameras, pair by pair, each with its camera's name; the truth of the views is noted."""
    for one in frames:
        seen.append(one.bodies)
        yield from zip(CAMERAS, one.views, strict=True)


def cameras_of(rig: Rig) -> Calibration:
    """The rig's own cameras, as a calibration."""
    return Calibration({name: getattr(rig, name).optics.camera() for name in CAMERAS})


def truth_name(body: str) -> str:
    """File of a body's truth, in the sweep's own folder of truth."""
    return TRUTH if body == PROBE else f"bodies/{body}.npz"


def truth_arrays(times: NDArray[np.int64], made: Sequence[Take], seen: Sequence[Seen], body: str = PROBE) -> dict[str, NDArray]:
    """Truth of a body by name: (n, ...) of each frame, (n, 2, ...) of each view; lengths in mm and px."""
    views = {
        name: np.array([[getattr(view, name) for view in bodies[body]] for bodies in seen])
        for name in ("centres", "ellipses", "inside", "blur_px", "visible", "white_dn")
    }
    motions = [take.held[body].motion for take in made]
    return {
        "times_ns": times,
        "world_from_target": np.array([motion.world_from_target for motion in motions]),
        "shift_mm": np.array([motion.shift_mm for motion in motions]),
        "turn_rad": np.array([motion.turn_rad for motion in motions]),
        **views,
    }
