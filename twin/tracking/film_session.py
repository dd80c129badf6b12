"""Films: a hand leads the target along a smooth path before both cameras, frame by frame, with the truth of each.

One body, one surroundings, one light and one exposure for all frames, all from a seed. Over an exposure the target moves evenly,
by the path's own derivative in the middle of it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.capture.manifest import CAMERAS, Device
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.circle_layout import circle_centres
from recon.model.rig import Positive, Rig
from scenes.scene_types import Scene
from twin import conditions
from twin.session import Session, describe
from twin.shooting import FilmQuality, Quality, Shooting
from twin.tracking.film_path import STILL, FilmPath
from twin.tracking.mesh_bank import Bank, build_bank, uncovered
from twin.tracking.rendered_views import Frames, render_film, render_full, white_radiance
from twin.tracking.samples import Motion, Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import ViewTruth

Array = NDArray[np.float64]

TRUTH = "film.npz"  # in the sweep's own folder of truth
BODIES = 4  # of which the one is taken whose fingers and cable cover least of the circles
LOOKS = 8  # frames in which that is looked at
NEAREST_MM = 100.0  # of a circle before a camera, along its axis
BATCH = 6  # frames traced in one launch; doesn't change them

Views = tuple[ViewTruth, ViewTruth]


class Filming(Shooting):
    """Settings of a film."""

    frames: Annotated[int, Field(ge=1, le=100_000)] = 30
    camera_hz: Positive = 30.0
    path: FilmPath

    @model_validator(mode="after")
    def _one_after_the_other(self) -> "Filming":
        if self.exposure_s * self.camera_hz > 1:
            raise ValueError(f"exposure_s: expected at most 1 / camera_hz = {1 / self.camera_hz:.4g}, found {self.exposure_s:g}")
        return self

    @property
    def times(self) -> NDArray[np.int64]:
        """Middles of the exposures : (n,) ns."""
        return np.rint(np.arange(self.frames) * 1e9 / self.camera_hz).astype(np.int64)


def make_bank(rig: Rig, seed: int) -> Bank:
    """The bodies and surroundings that a film is chosen from."""
    return build_bank(rig.target, BODIES, seed)


def takes(bank: Bank, rig: Rig, ranges: DataRanges, filming: Filming, seed: int, errors: conditions.Motion = STILL) -> list[Take]:
    """Parameters of each frame: all is drawn once, as for a data set's sample, but the pose, the motion and the noise."""
    light = ranges.light.model_copy(update={"projector_share": 0.0})
    drawn = draw(ranges.model_copy(update={"variants": BODIES, "light": light}), rig, seed, 0)
    cameras = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    way = filming.path.lead(rig.target, (cameras[0].centre + cameras[1].centre) / 2, seed, errors)
    motions = [way.motion(time * 1e-9, filming.exposure_s) for time in filming.times.tolist()]
    for motion in motions:
        places = rigid.apply(motion.world_from_target, circle_centres(rig.target))
        if min(rigid.apply(camera.camera_from_world, places)[:, 2].min() for camera in cameras) < NEAREST_MM:
            raise InputError(f"path: expected places at least {NEAREST_MM:g} mm before both cameras, found nearer ones")
    some = [motions[k].world_from_target for k in np.linspace(0, len(motions) - 1, min(LOOKS, len(motions))).astype(int)]
    eyes = np.array([rigid.apply(rigid.invert(pose), camera.centre) for pose in some for camera in cameras])
    moved = filming.path.room_mm - drawn.motion.world_from_target[:3, 3]
    lamps = drawn.lighting.lamps.copy()
    lamps[:, :3] += moved
    same = replace(
        drawn,
        cameras=(rig.cam1, rig.cam2),
        present=True,
        body=int(np.argmax([uncovered(bank, body, rig.target, eyes) for body in range(BODIES)])),
        lighting=replace(drawn.lighting, lamps=lamps),
        scene_from_world=drawn.scene_from_world @ rigid.transform(np.eye(3), -moved),
    )
    return in_a_row(same, motions, rig, filming, seed, errors)


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


def shoot(
    bank: Bank, rig: Rig, made: Sequence[Take], quality: FilmQuality, seed: int, pixels: Literal["sketch", "full"] = "sketch"
) -> Iterator[Frames]:
    """Render the frames one after the other."""
    for first in range(0, len(made), BATCH):
        some = made[first : first + BATCH]
        if pixels == "sketch":
            yield from render_film(bank, rig, some, quality, seed)
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
        seen: list[Views] = []
        capture.complete_calibration(cameras_of(calibrated))
        capture.add_sweep(
            dict.fromkeys(CAMERAS, filming.times),
            images(frames, seen),
            devices(rig, filming),
            name=session.part.partition("/")[2],
        )
        truth.write_arrays(
            f"{session.part}/{TRUTH}", {**truth_arrays(filming.times, made, seen), **filming.path.truth(rig.target)}
        )


def devices(rig: Rig, shooting: Shooting) -> dict[str, Device]:
    """Both cameras as they are set."""
    sizes = {name: getattr(rig, name).optics.size for name in CAMERAS}
    return {name: Device(size=size, exposure_s=shooting.exposure_s, gain=shooting.gain) for name, size in sizes.items()}


def images(frames: Iterable[Frames], seen: list[Views]) -> Iterator[tuple[str, NDArray]]:
    """Images of both cameras, pair by pair, each with its camera's name; the truth of the views is noted."""
    for one in frames:
        seen.append(one.truth)
        yield from zip(CAMERAS, one.views, strict=True)


def cameras_of(rig: Rig) -> Calibration:
    """The rig's own cameras, as a calibration."""
    return Calibration({name: getattr(rig, name).optics.camera() for name in CAMERAS})


def truth_arrays(times: NDArray[np.int64], made: Sequence[Take], seen: Sequence[Views]) -> dict[str, NDArray]:
    """By name: (n, ...) of each frame, (n, 2, ...) of each view; lengths in mm and px."""
    views = {
        name: np.array([[getattr(view, name) for view in both] for both in seen])
        for name in ("centres", "ellipses", "inside", "blur_px", "visible", "white_dn")
    }
    return {
        "times_ns": times,
        "world_from_target": np.array([take.motion.world_from_target for take in made]),
        "shift_mm": np.array([take.motion.shift_mm for take in made]),
        "turn_rad": np.array([take.motion.turn_rad for take in made]),
        **views,
    }
