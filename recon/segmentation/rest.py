"""Tissue at rest: what a probe's pressure and the patient's breath have moved in each B-scan is put back as under the fringes.

The distance of the array's face from the resting skin is parted into breath, by which the whole body rises along the chest's
normal, and the rest (`recon.segmentation.breath`). A face within the skin has pressed it in: tissue below gave way as a layer
does that keeps its volume (`recon.segmentation.pressed_layer`). A face off the skin stands on gel, unless the B-scan shows tissue
at once: then the body has risen. Of a skin that a face draws aside, nothing is seen.

What the layer leaves out is in the uncertainty, as shares of what was undone: tissues of unlike stiffness, another foot, or base.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import ConvexHull

from recon import threads
from recon.files.metrics import Metrics
from recon.freehand.scans import Scans
from recon.segmentation import breath, contact, pressed_layer
from recon.segmentation.contact import Contact
from recon.segmentation.containment import below
from recon.segmentation.pressed_layer import Patches, Response

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

NODES = (26, 21)  # of a grid over each B-scan, down and along, that displacements are kept on
PATCHES = (12, 3)  # of the foot, along the array and across
POINTS = 3  # of a patch, along the array, at which the skin is looked up
DEPTHS_MM = np.array([0, 1, 2, 4, 6, 8, 11, 14, 18, 22, 26, 30, 35, 40, 50, 60, 80.0])  # at which the layer is worked out
BASES_MM = 2.0  # in which steps of the base's depth
FAR_MM = 50.0  # off the skin: as where there is none
RATE_HZ = 20.0  # of B-scans whose times aren't known; assumed


@dataclass(frozen=True)
class Foot:
    """The probe's foot, by which it presses; of a linear array, assumed flat. Displacements by 6 and 14 mm differ by a tenth."""

    across_mm: float = 10.0  # across the array, along which it is as long as the array


@dataclass(frozen=True)
class RestLimits:
    """What is undone, and what of it stays unknown."""

    least_mm: float = 0.3  # within the skin, or off it with a breath: nothing is undone, for noise and gel; all from twice
    least_sigma: float = 3.0  # standard deviations of the contact, if that is more
    gel_mm: float = 1.0  # above tissue that the B-scan shows at once, as `contact.LIMITS` allows
    risen_mm: float = 2.0  # off a skin that some B-scans show at once, from where the body has risen, in others by less
    some: float = 0.05  # share of the B-scans
    neighbours: int = 9  # B-scans, of which most show gel, or don't
    texture: float = 0.3  # of the grey levels' spread in tissue, from where a row shows tissue
    most_pressed_mm: float = 6.0  # beyond these, something else is wrong, and nothing is undone
    most_risen_mm: float = 12.0
    least_base_mm: float = 30.0  # depth of the base below the face
    law: float = 0.15  # standard deviation, as a share of what was undone of pressure: of its decay with depth
    aside: float = 0.2  # likewise of what moved aside, by tissues of unlike stiffness or a skin that is drawn along
    risen: float = 0.1  # likewise of breath: the hand goes along less, or the chest rises another way by 10 degrees
    left_mm: float = 0.5  # likely left of a mass' place, from where that is a warning
    likely: float = 2.0  # standard deviations


FOOT, LIMITS = Foot(), RestLimits()


@dataclass(frozen=True, eq=False)
class Rest:
    """What moved the tissue in n B-scans."""

    risen_mm: Array  # (n,) of the body, along `up`
    pressed_mm: Array  # (n,) to which the face pressed the skin in
    up: Array  # (3,) unit, in the world: the chest's normal, towards the camera
    fields: NDArray[np.float32]  # (n, *NODES, 2) mm along array and beam, from where tissue rests to where it lay; over `undone`
    axes: Array  # (n, 3, 3) unit, in the world: columns along the array, the beam and across both
    shape: tuple[int, int]  # of the B-scans
    scale: tuple[float, float]  # mm a pixel
    parted_mm: Array  # (n,) standard deviation of breath against pressure
    contact_mm: float  # standard deviation of the skin's distance in all B-scans
    kept_mm: Array  # (n,) of pressure and breath that is left as it is: too little, or too much to be believed
    gel_mm: Array  # (n,) that the face seems to stand off, left as it is: gel, or a body that has risen
    period_s: float | None  # of the breath, where one was found

    @property
    def undone_mm(self) -> Array:
        """By which the skin had moved : (n,)."""
        return np.hypot(self.risen_mm, self.pressed_mm)

    @property
    def moved(self) -> NDArray[np.bool_]:
        """B-scans : (n,) in which something is undone."""
        return self.undone_mm > 0

    @property
    def figures(self) -> Metrics:
        """Figures, each named with its unit."""
        if not self.moved.any():
            return {"undone_mm": 0.0, "undone_most_mm": 0.0}
        found: Metrics = {"undone_mm": float(np.median(self.undone_mm)), "undone_most_mm": _most(self.undone_mm)}
        found |= {"pressed_mm": float(np.median(self.pressed_mm)), "risen_mm": float(np.median(self.risen_mm))}
        return found

    @property
    def lines(self) -> list[str]:
        """What was undone; none where nothing was."""
        parts = []
        if self.pressed_mm.any():
            parts.append(f"the skin was pressed in by {np.median(self.pressed_mm):.2f} mm, 95 % {_most(self.pressed_mm):.2f}")
        if self.risen_mm.any():
            every = "" if self.period_s is None else f" every {self.period_s:.1f} s"
            parts.append(f"the body rose by {np.median(self.risen_mm):.2f} mm, 95 % {_most(self.risen_mm):.2f}{every}")
        told = [f"rest        undone: {'; '.join(parts)}"] if parts else []
        if wild := int((self.kept_mm > LIMITS.most_pressed_mm).sum()):
            told.append(
                f"warning     rest: in {wild} B-scans the face lies too deep in the skin, or too far off: nothing is undone"
            )
        return told

    def pressed_at(self, scans: NDArray[np.int64], pixels: Array) -> Array:
        """Displacements : (m, 3) mm in the world, by pressure, of what rests at pixels : (m, 2) u, v of B-scans : (m,)."""
        at = np.clip(pixels[:, ::-1] / (np.array(self.shape) - 1), 0, 1) * (np.array(NODES) - 1)
        low = np.minimum(at.astype(int), np.array(NODES) - 2)
        (i, j), (a, b) = low.T, (at - low).T[..., None]
        field = (1 - a) * ((1 - b) * self.fields[scans, i, j] + b * self.fields[scans, i, j + 1])
        field += a * ((1 - b) * self.fields[scans, i + 1, j] + b * self.fields[scans, i + 1, j + 1])
        return np.einsum("mik,mk->mi", self.axes[scans][:, :, :2], field)

    def unknown(self, scans: NDArray[np.int64], pixels: Array) -> Array:
        """Displacements : (k, m, 3) mm that are left, each of one cause and one standard deviation, of pixels as above."""
        by_pressure, axes = self.pressed_at(scans, pixels), self.axes[scans]
        pressed, risen = self.pressed_mm[scans, None], self.risen_mm[scans, None] * self.up
        of_skin = np.divide(by_pressure, pressed, out=np.zeros_like(by_pressure), where=pressed > 0)
        aside = LIMITS.aside * np.linalg.norm(by_pressure, axis=1)[:, None]
        together = np.where(pressed > 0, of_skin, np.where(self.risen_mm[scans, None] != 0, self.up, 0.0))
        parted = np.where(self.moved[scans, None], self.up + of_skin, 0.0)
        return np.stack(
            [
                LIMITS.law * by_pressure,
                aside * axes[:, :, 0],
                aside * axes[:, :, 2],
                LIMITS.risen * risen,
                self.parted_mm[scans, None] * parted,
                self.contact_mm * together,
                self.kept_mm[scans, None] * self.up,
                self.gel_mm[scans, None] / np.sqrt(12) * self.up,
            ]
        )


def find(scans: Scans, skin: trimesh.Trimesh, touching: Contact) -> Rest | None:
    """What moved the tissue in B-scans, by the contact of the face with the resting skin; None where that isn't known."""
    placed = np.isfinite(scans.world_from_pixel).all(axis=(1, 2))
    lowest = min(touching.median_mm, 0.0) - contact.LIMITS.foreign_mm
    believed = (touching.distances_mm > lowest) & (touching.distances_mm < LIMITS.most_risen_mm)
    distances = np.where(believed, touching.distances_mm, np.nan)
    if np.isfinite(distances).sum() < contact.LIMITS.fewest:
        return None
    scale, axes = _axes(scans.world_from_pixel, placed)
    up, level = _base(skin)
    patches = _patches(scans.shape[1], scale[0])
    depths, normals, origins = _within(scans, skin, placed, axes, patches)
    shares = np.clip(normals @ up, 0.3, 1.0)
    known = scans.times_s is not None and (np.diff(scans.times_s) > 0).all()
    times_s = scans.times_s if known else np.arange(len(placed)) / RATE_HZ
    contact_mm = touching.sigma_mm if np.isfinite(touching.sigma_mm) else contact.LIMITS.given_mm
    least_mm = max(LIMITS.least_mm, LIMITS.least_sigma * contact_mm)
    parts = breath.part(times_s, distances, shares)
    risen, left = parts.breath, parts.rest
    if parts.period_s is not None and abs(np.median(left)) < least_mm:
        risen, left = risen + np.median(left) / shares, left - np.median(left)
    seen = _touches(scans, left, np.rint(patches.x[depths.argmax(axis=1)] / scale[0]).astype(int), scale)
    off = np.where(seen, _risen(left, seen, least_mm), 0.0)
    risen, left = risen + off / shares, left - off
    pressed = np.maximum(-left, 0) * np.clip(-left / least_mm - 1, 0, 1)
    wild = (pressed > LIMITS.most_pressed_mm) | (np.abs(risen) > LIMITS.most_risen_mm) | ~placed
    whole = np.hypot(np.maximum(-left, 0), np.where(wild, risen, 0.0))
    risen, pressed = np.where(wild, 0.0, risen), np.where(wild, 0.0, pressed)
    pressed = pressed if _most(pressed) > least_mm else np.zeros_like(pressed)
    kept = np.where(placed & (whole - pressed > least_mm), whole - pressed, 0.0)
    raw = np.where(np.isfinite(distances), distances, -np.maximum(depths.max(axis=1), -FAR_MM))
    bases = np.maximum(((origins - level) @ up) / np.maximum(-axes[:, :, 1] @ up, 0.3), LIMITS.least_base_mm)
    fields = _fields(depths + raw[:, None] + pressed[:, None], pressed, bases, patches, scans, scale)
    gel = np.where(seen & (left > least_mm), left, 0.0)
    parted = np.full(len(placed), left.std()) if parts.period_s is None else parts.sigma  # what changes may be a part of a breath
    period_s = parts.period_s if known else None
    return Rest(risen, pressed, up, fields, axes, scans.shape, scale, parted, contact_mm, kept, gel, period_s)


def undone(scans: Scans, rest: Rest) -> Scans:
    """The B-scans as of tissue at rest: what each pixel shows is put where it rests, in planes that breath has moved back.

    They begin at the skin at rest, or the tissue that was pressed together below it would be lost.
    """
    if not rest.moved.any():
        return scans
    back, began = np.tile(np.eye(4), (2, len(scans.world_from_pixel), 1, 1))
    back[:, :3, 3] = -rest.risen_mm[:, None] * rest.up
    began[:, 1, 3] = -rest.pressed_mm / rest.scale[1]
    return replace(scans, world_from_pixel=back @ scans.world_from_pixel @ began, stream=partial(_stream, scans, rest))


def warnings_of(name: str, left_mm: float) -> list[str]:
    """A warning, where more of a mass's place at rest may be left than allowed; left_mm : standard deviation."""
    most = LIMITS.likely * left_mm
    if most <= LIMITS.left_mm:
        return []
    left = f"up to {most:.1f} mm ({LIMITS.likely:g} sigma) of pressure and breath may be left in its place"
    return [f"warning     {name}: {left}; press less, let the patient hold her breath as under the fringes"]


def _stream(scans: Scans, rest: Rest) -> Iterator[Image]:
    """Images of tissue at rest. Levels are those of the nearest pixel: between them they'd be those of no speckle."""
    height, width = scans.shape
    pixels = np.dstack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)))
    node_from_pixel = np.diag([(NODES[1] - 1) / (width - 1), (NODES[0] - 1) / (height - 1), 1.0])[:2]
    between = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}

    def at_rest(image: Image, field: NDArray[np.float32], pressed: float) -> Image:
        if pressed == 0:
            return image
        shift = (field - np.float32([0, pressed])) / np.float32(rest.scale)
        lay = pixels + cv2.warpAffine(shift, node_from_pixel, (width, height), **between)
        return cv2.remap(image, lay, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)

    return threads.mapped(at_rest, scans.stream(), rest.fields, rest.pressed_mm.tolist())


def _axes(world_from_pixel: Array, placed: NDArray[np.bool_]) -> tuple[tuple[float, float], Array]:
    """Pixel's size, mm, and unit axes : (n, 3, 3) along the array, the beam and across; NaN without a pose."""
    lengths = np.linalg.norm(world_from_pixel[:, :3, :2], axis=1)
    first = lengths[placed][0]
    axes = np.full((len(placed), 3, 3), np.nan)
    axes[..., :2] = world_from_pixel[:, :3, :2] / lengths[:, None]
    axes[..., 2] = np.cross(axes[..., 0], axes[..., 1])
    return (float(first[0]), float(first[1])), axes


def _base(skin: trimesh.Trimesh) -> tuple[Array, Array]:
    """The chest's normal : (3,), towards the camera, and a point : (3,) mm on the base: of a plane through the skin's outline."""
    points = np.asarray(skin.vertices, float)
    middle = points.mean(axis=0)
    across = np.linalg.svd(points[:: max(1, len(points) // 2000)] - middle, full_matrices=False)[2][:2]
    rim = points[ConvexHull((points - middle) @ across.T).vertices]
    level = rim.mean(axis=0)
    normal = np.linalg.svd(rim - level)[2][2]
    return normal * -np.sign(normal @ level), level


def _patches(columns: int, mm: float) -> Patches:
    """Patches of the foot; x counts from the first column."""
    width = (columns - 1) * mm
    halves = width / PATCHES[0] / 2, FOOT.across_mm / PATCHES[1] / 2
    x, y = (half * (2 * np.arange(count) + 1) for half, count in zip(halves, PATCHES, strict=True))
    along, across = np.meshgrid(x, y - FOOT.across_mm / 2, indexing="ij")
    return Patches(along.ravel(), across.ravel(), halves)


def _within(
    scans: Scans, skin: trimesh.Trimesh, placed: NDArray[np.bool_], axes: Array, patches: Patches
) -> tuple[Array, Array, Array]:
    """Depths : (n, m) mm along the beam of the foot's patches within the resting skin, mean normals of the skin : (n, 3), and
    middles of the face : (n, 3).
    """
    row = 0.0 if scans.probe is None else scans.probe.face_row
    first = scans.world_from_pixel[:, :3, 3] + row * scans.world_from_pixel[:, :3, 1]
    steps = patches.half_mm[0] * (np.arange(POINTS) - (POINTS - 1) / 2) * 2 / POINTS
    x, y = (patches.x[:, None] + steps).ravel(), np.repeat(patches.y, POINTS)
    used = np.flatnonzero(placed)
    places = first[used, None] + x[:, None] * axes[used, None, :, 0] + y[:, None] * axes[used, None, :, 2]
    deep, towards, _ = below(places.reshape(-1, 3), skin)
    towards, beams = towards.reshape(*places.shape), axes[used, None, :, 1]
    along = deep.reshape(places.shape[:2]) / np.clip(-(towards * beams).sum(axis=2), 0.3, None)
    along = np.where(np.isnan(along), -np.inf, along).reshape(len(used), -1, POINTS)
    depths, normals = np.full((len(placed), len(patches.x)), -np.inf), np.zeros((len(placed), 3))
    depths[used], normals[used] = along.mean(axis=2), towards.mean(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    middle = first + axes[..., 0] * (scans.shape[1] - 1) / 2 * np.linalg.norm(scans.world_from_pixel[:, :3, 0], axis=1)[:, None]
    return depths, normals, middle


def _fields(
    depths: Array, pressed: Array, bases: Array, patches: Patches, scans: Scans, scale: tuple[float, float]
) -> NDArray[np.float32]:
    """Displacements : (n, *NODES, 2) mm along array and beam by feet at depths : (n, m) mm within the resting skin."""
    row = 0.0 if scans.probe is None else scans.probe.face_row
    height, width = scans.shape
    x, z = scale[0] * np.linspace(0, width - 1, NODES[1]), scale[1] * (np.linspace(0, height - 1, NODES[0]) - row)
    middle = slice(PATCHES[1] // 2, None, PATCHES[1])
    layers: dict[float, tuple[Array, Response]] = {}
    found = np.zeros((len(depths), *NODES, 2), np.float32)
    for k in np.flatnonzero(pressed > 0).tolist():
        base = BASES_MM * float(np.round(bases[k] / BASES_MM))
        if base not in layers:
            layers[base] = pressed_layer.compliance(patches, base), pressed_layer.respond(patches, x, DEPTHS_MM, base)
        skin, response = layers[base]
        force = pressed_layer.pressures(skin, np.maximum(depths[k], -FAR_MM))
        above = np.interp(x, patches.x[middle], np.maximum(depths[k, middle], -FAR_MM))  # the skin at rest, of the face
        for axis, moved in enumerate((response.along @ force, response.down @ force)):
            found[k, :, :, axis] = np.stack(
                [np.interp(z - pressed[k] + lifted, DEPTHS_MM, one) for lifted, one in zip(above, moved, strict=True)], axis=1
            )
    return found


def _touches(scans: Scans, off_mm: Array, columns: NDArray[np.intp], scale: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether a B-scan : (n,) shows tissue nearer to the face than the resting skin lies off it, where that is more than gel.

    columns : (n,) where the skin is nearest
    """
    found = np.ones(len(off_mm), bool)
    if not (off_mm > LIMITS.gel_mm).any():
        return found
    row = 0 if scans.probe is None else max(0, round(scans.probe.face_row))
    half, run = (max(2, round(mm / one)) for mm, one in zip((3.0, 0.5), scale, strict=True))
    deep = slice(row + round(5 / scale[1]), row + round(10 / scale[1]))
    for k, image in enumerate(scans.stream()):
        if off_mm[k] > LIMITS.gel_mm:
            spread = image[:, max(0, columns[k] - half) : columns[k] + half + 1].std(axis=1)
            mean = np.convolve(spread[row:], np.ones(run) / run, "valid")
            dark = mean < LIMITS.texture * np.median(spread[deep])
            last = scale[1] * (len(dark) if dark.all() else int(dark.argmin()))
            found[k] = last < max(LIMITS.gel_mm, off_mm[k] / 2)
    return median_filter(found.view(np.uint8), LIMITS.neighbours).view(bool)


def _risen(off_mm: Array, seen: NDArray[np.bool_], least_mm: float) -> Array:
    """By which a body has risen in B-scans : (n,) that begin with tissue, though in some the face stands off the resting skin.

    The least distance counts as gel, up to half of what B-scans don't show of it, or as even pressure.
    """
    if np.mean(seen & (off_mm > LIMITS.risen_mm)) < LIMITS.some:
        return np.zeros_like(off_mm)
    nearest = float(np.quantile(off_mm, LIMITS.some))
    return np.maximum(off_mm - (nearest if nearest < -least_mm else np.clip(nearest, 0, LIMITS.gel_mm / 2)), 0)


def _most(values: Array) -> float:
    """Beyond which lies a twentieth."""
    return float(np.quantile(values, 0.95))
