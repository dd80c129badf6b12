"""Parameters of several takes side by side, from which each ray fetches those of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.rig import Rig
from twin.tracking.samples import Held, Take

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rows:
    """Named numbers, a row a take (or a camera), and the row that each lane reads."""

    values: mi.Float  # (rows * width,)
    places: Mapping[str, tuple[int, int]]  # first column and count of each name
    width: int
    index: mi.UInt32  # (lanes,)

    @classmethod
    def of(cls, columns: Mapping[str, Array], index: mi.UInt32) -> "Rows":
        """Lay out columns : each (rows, ...)."""
        places, blocks, first = {}, [], 0
        for name, column in columns.items():
            block = np.asarray(column, float).reshape(len(column), -1)
            places[name] = (first, block.shape[1])
            blocks.append(block)
            first += block.shape[1]
        return cls(mi.Float(np.float32(np.concatenate(blocks, axis=1)).ravel()), places, first, index)

    def all(self, name: str) -> list[mi.Float]:
        """All numbers of a name."""
        first, count = self.places[name]
        return [dr.gather(mi.Float, self.values, self.index * self.width + (first + k)) for k in range(count)]

    def number(self, name: str) -> mi.Float:
        """The one number of a name."""
        return self.all(name)[0]

    def vector(self, name: str) -> mi.Vector3f:
        """Three numbers as a vector."""
        return mi.Vector3f(*self.all(name))

    def chosen(self, name: str, row: mi.UInt32, count: int) -> list[mi.Float]:
        """One row of a table with `count` columns, by a number that differs from ray to ray."""
        first, _ = self.places[name]
        start = self.index * self.width + (first + row * count)
        return [dr.gather(mi.Float, self.values, start + k) for k in range(count)]


@dataclass(frozen=True)
class Turn:
    """A rigid transform that differs from lane to lane."""

    rows: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]  # of the rotation
    shift: mi.Vector3f

    @classmethod
    def of(cls, rows: Rows, name: str) -> "Turn":
        """From a column of 4x4 matrices."""
        m = rows.all(name)
        return cls((mi.Vector3f(*m[0:3]), mi.Vector3f(*m[4:7]), mi.Vector3f(*m[8:11])), mi.Vector3f(m[3], m[7], m[11]))

    def rotate(self, v: mi.Vector3f) -> mi.Vector3f:
        """Turn a direction."""
        return mi.Vector3f(*(dr.dot(row, v) for row in self.rows))

    def rotate_back(self, v: mi.Vector3f) -> mi.Vector3f:
        """Turn a direction the other way."""
        return self.rows[0] * v.x + self.rows[1] * v.y + self.rows[2] * v.z

    def apply(self, p: mi.Vector3f) -> mi.Vector3f:
        """Move a point."""
        return self.rotate(p) + self.shift


def take_columns(takes: Sequence[Take], rig: Rig, body_at: Array, scene_at: Array) -> dict[str, Array]:
    """Columns of a take's parameters : (takes, ...); variants stand at body_at, scene_at : (variants, 3) mm in their banks."""
    lights = [take.lighting for take in takes]
    into_scene = np.array([take.scene_from_world for take in takes])
    into_scene[:, :3, 3] += scene_at[[take.surroundings for take in takes]]
    projector = rig.projector.optics.camera()
    m = projector.matrix
    bodies = [held_columns(name, [take.held[name] for take in takes], body_at) for name in takes[0].held]
    return {
        **{name: column for columns in bodies for name, column in columns.items()},
        "scene_from_world": into_scene,
        "lamps": np.array([light.lamps for light in lights]),
        "ambient": np.array([light.ambient for light in lights]),
        "gradient": np.array([light.gradient for light in lights]),
        "projector": np.array([light.projector for light in lights]),
        "projector_from_world": np.repeat(projector.camera_from_world[None], len(takes), axis=0),
        "projector_matrix": np.repeat([[m[0, 0], m[1, 1], m[0, 2], m[1, 2], *projector.size]], len(takes), axis=0),
        "surfaces": np.array([take.surfaces for take in takes]),
        "texture_shift": np.array([take.texture_shift for take in takes]),
    }


def held_columns(name: str, held: Sequence[Held], body_at: Array) -> dict[str, Array]:
    """Columns of one body's parameters : (takes, ...), each named after the body and itself."""
    angle = np.array([np.linalg.norm(one.motion.turn_rad) for one in held])
    columns = {
        "present": np.array([float(one.present) for one in held]),
        "target_from_world": np.array([rigid.invert(one.motion.world_from_target) for one in held]),
        "origin": np.array([one.motion.world_from_target[:3, 3] for one in held]),
        "shift": np.array([one.motion.shift_mm for one in held]),
        "axis": np.array([one.motion.turn_rad for one in held]) / np.maximum(angle, 1e-12)[:, None],
        "angle": angle,
        "body_at": body_at[[one.body for one in held]],
        "print": np.array([[o.face.ink, o.face.paper, o.face.unevenness, max(o.face.softness_mm, 0.01)] for o in held]),
        "scratches": np.array([one.face.scratches for one in held]),
        "spots": np.array([one.face.spots for one in held]),
    }
    return {f"{name} {column}": values for column, values in columns.items()}


def camera_columns(takes: Sequence[Take]) -> dict[str, Array]:
    """Columns of the cameras' parameters : (takes * 2, ...); InputError for a lens with more than five coefficients."""
    devices = [device for one in takes for device in one.cameras]
    cameras = [device.optics.camera() for device in devices]
    for camera in cameras:
        if np.any(camera.distortion[5:]):
            raise InputError(f"rig: distortion: expected k1 k2 p1 p2 k3 at most, found {camera.distortion.size} coefficients")
    distortion = [np.pad(camera.distortion, (0, 5))[:5] for camera in cameras]
    middle = [(np.array(camera.size) - 1) / 2 for camera in cameras]
    return {
        "world_from_camera": np.array([rigid.invert(camera.camera_from_world) for camera in cameras]),
        "pinhole": np.array([camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras]),
        "distortion": np.array(distortion),
        "late": np.array([late for one in takes for late in one.late]),
        "lens": np.array([
            [d.lens.aperture_mm / 2, d.lens.focus_mm, d.lens.blur_px, d.lens.vignetting, *m, 1 / (m @ m)]
            for d, m in zip(devices, middle, strict=True)
        ]),
    }  # fmt: skip
