"""Frames of a sweep: both cameras see the rig's own body, led by a hand, over the very scene that is scanned.

The body is built from `rig.target` and `rig.probe`, so that its array lies where the B-scans begin. Of some bodies the one is
taken whose hand, bracket and cable cover least of the circles.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture.manifest import Device
from recon.capture.writer import CaptureWriter
from recon.geometry import rigid
from recon.model.rig import Rig
from scenes.handheld import lofts
from scenes.handheld.handheld_assembly import as_designed
from scenes.handheld.mesh_parts import Part
from scenes.handheld.surroundings import BENCH_MM, FLOAT_MM, Surroundings
from scenes.scene_types import Scene, Thing
from twin import conditions
from twin.session import TruthFolder
from twin.shooting import FrameShooting
from twin.tracking import film_session
from twin.tracking.film_session import LOOKS, STILL, Seen, in_a_row
from twin.tracking.mesh_bank import Bank, bank_of, uncovered
from twin.tracking.rendered_views import Frames
from twin.tracking.samples import LAMPS, Lighting, Motion, Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.study_samples import CLEAN

Array = NDArray[np.float64]

BODIES, DRAWN = 2, 6  # bodies in a hand to choose from, and bodies that are drawn at most to have them
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
        arrays = film_session.truth_arrays(self.times, self.made, self.seen)
        truth.write_arrays(f"{truth.part}/{film_session.TRUTH}", arrays)


def make_bank(scene: Scene, rig: Rig, led: Sequence[Motion], seed: int) -> Bank:
    """The bodies that one is chosen from for some motions, and the scene, in the world's frame.

    Raises
    ------
    InputError
        If `rig.probe` stands where its housing would pierce the target's board.
    """
    drawn, eyes = [], _eyes(rig, led)
    for rng in np.random.default_rng([seed, 4]).spawn(DRAWN):
        drawn.append(as_designed(rng, rig.target, rig.probe, eyes))
        if sum(map(_in_a_hand, drawn)) == BODIES:
            break
    bodies = [body for body in drawn if _in_a_hand(body)] or drawn
    return bank_of(bodies, [Surroundings(tuple(parts_of(scene)), ())])


def _in_a_hand(body: Sequence[Part]) -> bool:
    return any(part.slot == "skin" for part in body)


def parts_of(scene: Scene) -> list[Part]:
    """Things that cameras see, with their own reflectances, on a bench."""
    seen = [thing for thing in scene.things if not thing.inside]
    depth = max(float(thing.mesh.bounds[1, 2]) for thing in seen)
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


def takes(
    bank: Bank,
    rig: Rig,
    ranges: DataRanges,
    shooting: FrameShooting,
    led: Sequence[Motion],
    seed: int,
    errors: conditions.Motion = STILL,
) -> list[Take]:
    """Parameters of each pair of frames: surfaces and light are drawn once, as for a data set's sample; the print is clean."""
    light = ranges.light.model_copy(update={"projector_share": 0.0})
    drawn = draw(ranges.model_copy(update={"variants": BODIES, "light": light}), rig, seed, 0)
    middle, eyes = np.mean([motion.world_from_target[:3, 3] for motion in led], axis=0), _eyes(rig, led)
    same = replace(
        drawn,
        cameras=(rig.cam1, rig.cam2),
        present=True,
        body=int(np.argmax([uncovered(bank, body, rig.target, eyes) for body in range(len(bank.body_at))])),
        surroundings=0,
        scene_from_world=np.eye(4),
        lighting=_lighting(drawn, middle, rig, shooting.light),
        face=CLEAN,
    )
    return in_a_row(same, led, rig, shooting, seed, errors)


def _eyes(rig: Rig, led: Sequence[Motion]) -> Array:
    """Where both cameras stand in some of the motions : (n, 3) mm, in the target's frame."""
    some = [led[k].world_from_target for k in np.linspace(0, len(led) - 1, min(LOOKS, len(led))).astype(int)]
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
