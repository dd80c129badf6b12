"""Frames of a sweep: both cameras see the rig's own probe, led by a hand, and further bodies over the very scene that is scanned.

The probe is built from `rig.target` and `rig.probe`, so that its array lies where the B-scans begin. Of some variants the one is
taken whose hand, bracket and cable cover least of the circles. What stands beside it stands on the table, or the phantom.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture.manifest import Device
from recon.capture.writer import CaptureWriter
from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import PROBE, Rig
from scenes.handheld import lofts
from scenes.handheld.body_look import Look, Stand
from scenes.handheld.handheld_assembly import as_designed
from scenes.handheld.mesh_parts import Part
from scenes.handheld.standing_things import stand_at
from scenes.handheld.surroundings import BENCH_MM, FLOAT_MM, Surroundings
from scenes.scene_types import Scene, Thing
from twin import conditions
from twin.session import TruthFolder
from twin.shooting import FrameShooting
from twin.tracking import film_session
from twin.tracking.film_session import FAR_LAMPS_MM, LOOKS, STILL, Seen, in_a_row
from twin.tracking.mesh_bank import Bank, bank_of, uncovered, uncovered_share
from twin.tracking.rendered_views import Frames
from twin.tracking.samples import LAMPS, Held, Lighting, Motion, Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.study_samples import CLEAN

Array = NDArray[np.float64]

BODIES, DRAWN = 2, 6  # bodies in a hand to choose from, and those drawn at most to have them, or not to cover further bodies
AROUND = 0.1  # of the target's light, from all around, beside a projector in the dark


@dataclass(frozen=True, eq=False)
class SceneFilm:
    """Frames of a sweep, as they are written beside its B-scans."""

    rig: Rig  # as it took the frames
    calibrated: Rig  # as it was calibrated
    shooting: FrameShooting
    times: NDArray[np.int64]  # (m,) ns
    made: Sequence[Take]
    frames: Callable[[], Iterable[Frames]]  # renders them one by one
    looks: Mapping[str, Look]  # of further bodies
    seen: list[Seen] = field(default_factory=list)

    @property
    def devices(self) -> dict[str, Device]:
        """Both cameras as they are set."""
        return film_session.devices(self.rig, self.shooting)

    def images(self) -> Iterator[tuple[str, NDArray]]:
        """Render the images of both cameras, pair by pair, each with its camera's name."""
        return film_session.images(self.frames(), self.seen)

    def finish(self, capture: CaptureWriter, truth: TruthFolder) -> None:
        """Write the calibration, and the truth of what was rendered."""
        truth.write_optics(film_session.cameras_of(self.rig))
        capture.complete_calibration(film_session.cameras_of(self.calibrated))
        for name in self.made[0].held:
            tip = self.looks[name].tip_mm(self.rig.targets[name]) if name in self.looks else None
            arrays = film_session.truth_arrays(self.times, self.made, self.seen, name) | ({} if tip is None else {"tip_mm": tip})
            truth.write_arrays(f"{truth.part}/{film_session.truth_name(name)}", arrays)


@dataclass(frozen=True, eq=False)
class SceneStage:
    """What is filmed: a scene that has moved, and all bodies over n frames."""

    scene: Scene
    world_from_reference: Array  # (4, 4) mm, by which it has moved
    motions: Mapping[str, Sequence[Motion]]  # in the world, the probe's first
    looks: Mapping[str, Look]  # of the others

    def stand(self, name: str, parts: Sequence[Part], rig: Rig) -> Stand:
        """Where a body stands in the first frame, on what lies below it of the scene; an arm leads away from all bodies."""
        first = {other: motions[0].world_from_target for other, motions in self.motions.items()}
        middles = [rigid.apply(pose, circle_layout.middle(rig.targets[other])) for other, pose in first.items()]
        meshes, eyes = [part.mesh for part in parts], _eyes(rig, self.motions[name])
        return stand_at(first[name], rig.targets[name], meshes, eyes, np.mean(middles, axis=0), self.world_from_reference)


def make_bank(stage: SceneStage, rig: Rig, seed: int) -> Bank:
    """The probes that one is chosen from, further bodies, and the scene, as it was in the reference.

    Raises
    ------
    InputError
        If `rig.probe` stands where its housing would pierce the target's board.
    """
    drawn, eyes, wanted = [], _eyes(rig, stage.motions[PROBE]), DRAWN if stage.looks else BODIES
    for rng in np.random.default_rng([seed, 4]).spawn(DRAWN):
        drawn.append(as_designed(rng, rig.target, rig.probe, eyes, _views(rig, stage)))
        if sum(map(_in_a_hand, drawn)) == wanted:
            break
    bodies, parts = [body for body in drawn if _in_a_hand(body)] or drawn, parts_of(stage.scene)
    for number, (name, look) in enumerate(stage.looks.items(), 1):
        rng = np.random.default_rng([seed, 4, number])
        bodies.append(look.parts(rng, rig.targets[name], stage.stand(name, parts, rig)))
    return bank_of(bodies, [Surroundings(tuple(parts), ())])


def _in_a_hand(body: Sequence[Part]) -> bool:
    return any(part.slot == "skin" for part in body)


def parts_of(scene: Scene, resting: Scene | None = None) -> list[Part]:
    """Things that cameras see, with their own reflectances, on a bench: below where they rest, if they have moved."""
    seen = [thing for thing in scene.things if not thing.inside]
    depth = max(float(thing.mesh.bounds[1, 2]) for thing in (resting or scene).things if not thing.inside)
    bench = lofts.box([BENCH_MM, BENCH_MM, 40], [0, 0, depth + FLOAT_MM + 20])
    return [*(_part_of(thing) for thing in seen), Part("bench", bench, False)]


def _part_of(thing: Thing) -> Part:
    albedo = np.full(len(thing.mesh.vertices), thing.material.reflectance, np.float32) if thing.albedo is None else thing.albedo
    return Part("table" if thing.name == "table" else "phantom", _plain(thing.mesh), thing.smooth, albedo)


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def motions(poses: Array, before: Array, after: Array) -> list[Motion]:
    """Motions over an exposure, from poses `world_from_target` : (n, 4, 4) in its middle, at its beginning and at its end."""
    steps = (rigid.difference(one, other) for one, other in zip(before, after, strict=True))
    return [Motion(pose, step[3:], step[:3]) for pose, step in zip(poses, steps, strict=True)]


def _views(rig: Rig, stage: SceneStage) -> Array | None:
    """Lines of sight : (m, 2, 3) mm of both cameras to the circles of further bodies, in the probe's target's frame, in some of
    the frames; None without such bodies.
    """
    lines = []
    for k in _looked(len(stage.motions[PROBE])):
        into = rigid.invert(stage.motions[PROBE][k].world_from_target)
        for name in stage.looks:
            pose = into @ stage.motions[name][k].world_from_target
            circles = rigid.apply(pose, circle_layout.circle_centres(rig.targets[name]))
            for device in (rig.cam1, rig.cam2):
                eye = rigid.apply(into, device.optics.camera().centre)
                lines.append(np.stack([np.tile(eye, (len(circles), 1)), circles], axis=1))
    return np.concatenate(lines) if lines else None


def takes(
    stage: SceneStage,
    bank: Bank,
    rig: Rig,
    ranges: DataRanges,
    shooting: FrameShooting,
    seed: int,
    errors: conditions.Motion = STILL,
) -> list[Take]:
    """Parameters of each pair of frames: surfaces and light are drawn once, as for a data set's sample; prints are clean."""
    light = ranges.light.model_copy(update={"projector_share": 0.0} | ({"lamp_mm": FAR_LAMPS_MM} if stage.looks else {}))
    drawn = draw(ranges.model_copy(update={"variants": BODIES, "light": light}), rig, seed, 0)
    led = stage.motions[PROBE]
    middle = np.mean([motion.world_from_target[:3, 3] for motion in led], axis=0)
    probes = len(bank.body_at) - len(stage.looks)
    lines = {name: look.line_mm(rig.targets[name]) for name, look in stage.looks.items()}
    others = [
        {
            name: Held(stage.motions[name][k], number, CLEAN, line=line)
            for number, (name, line) in enumerate(lines.items(), probes)
        }
        for k in range(len(led))
    ]
    same = replace(
        drawn,
        cameras=(rig.cam1, rig.cam2),
        present=True,
        surroundings=0,
        scene_from_world=rigid.invert(stage.world_from_reference),
        lighting=_lighting(drawn, middle, rig, shooting.light),
        face=CLEAN,
    )
    if stage.looks:
        centres = np.array([device.optics.camera().centre for device in same.cameras])
        some = [replace(same, motion=led[k], others=others[k]) for k in _looked(len(led))]
        shares = [
            np.mean([uncovered_share(bank, replace(take, body=body), rig.targets, centres) for take in some])
            for body in range(probes)
        ]
    else:
        shares = [uncovered(bank, body, rig.target, _eyes(rig, led)) for body in range(probes)]
    made = in_a_row(replace(same, body=int(np.argmax(shares))), led, rig, shooting, seed, errors)
    return [replace(take, others=its) for take, its in zip(made, others, strict=True)]


def _looked(count: int) -> NDArray[np.int64]:
    """Numbers of some of so many frames."""
    return np.linspace(0, count - 1, min(LOOKS, count)).astype(int)


def _eyes(rig: Rig, led: Sequence[Motion]) -> Array:
    """Where both cameras stand in some of the motions : (n, 3) mm, in the target's frame."""
    some = [led[k].world_from_target for k in _looked(len(led))]
    centres = [device.optics.camera().centre for device in (rig.cam1, rig.cam2)]
    return np.array([rigid.apply(rigid.invert(pose), centre) for pose in some for centre in centres])


def _lighting(drawn: Take, middle: Array, rig: Rig, light: str) -> Lighting:
    """Light about the target's path, or the projector's; relative to each other, and about 1 on the target in all."""
    if light == "room":
        lamps = drawn.lighting.lamps.copy()
        lamps[:, :3] += middle - drawn.motion.world_from_target[:3, 3]
        return replace(drawn.lighting, lamps=lamps)
    dark = np.zeros((LAMPS, 5))
    dark[:, 3] = 1
    distance2 = float(np.sum((middle - rig.projector.optics.camera().centre) ** 2))
    return Lighting(dark, AROUND / np.pi, drawn.lighting.gradient, np.array([(1 - AROUND) * distance2, 1.0, 0.0, 12.0, 0.0]))
