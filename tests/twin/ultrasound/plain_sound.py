"""Slow, plain versions of the compiled code of the B-mode model: NumPy and SciPy, one rule after the other."""

from itertools import product

import numpy as np
from scipy.ndimage import map_coordinates

from recon.geometry import rigid
from scenes.tissue import Tissue
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import OVERSAMPLING, STEP_MM, Beam
from twin.ultrasound.echo_field import BESIDE_MM, field_like
from twin.ultrasound.echo_solids import Body, Solid, Wire
from twin.ultrasound.medium import hashed
from twin.ultrasound.sound_paths import GRADIENT_MM, Paths
from twin.ultrasound.surface_echoes import ACROSS_MM, ALONG_MM, PATCH_MM, RINGS, SUBLINES, TAPER
from twin.ultrasound.transducer import Transducer

MARCH_MM = 0.05  # between places where a ray's tissue is looked up


def distances(body: Body, points: np.ndarray) -> np.ndarray:
    """Signed distances : (k, n) of points : (n, 3) to the solids; 1e3 outside their grids."""
    return np.array([distance(one, points) for one in body.solids])


def distance(one: Solid, points: np.ndarray) -> np.ndarray:
    """Signed distances : (n,) of points : (n, 3) to a solid; 1e3 outside its grid, which a box doesn't need."""
    if one.is_box:
        low, high = one.mesh.bounds
        inside = np.minimum(points - low, high - points).min(axis=1)
        return np.where(inside < 0, np.linalg.norm(points - np.clip(points, low, high), axis=1), -inside)
    return map_coordinates(one.distance, ((points - one.origin) / one.spacing).T, output=float, order=1, cval=1e3)


def labels(body: Body, points: np.ndarray) -> np.ndarray:
    """Labels : (n,): the last solid that holds a point, or 0."""
    numbers = np.arange(1, len(body.solids) + 1)[:, None]
    return ((distances(body, points) <= 0) * numbers).max(axis=0)


def distance_to(body: Body, solids: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distances : (n,), each to a solid of its own."""
    found = np.empty(len(points))
    for k in np.unique(solids):
        found[solids == k] = distance(body.solids[k], points[solids == k])
    return found


def normals(body: Body, solids: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Outward normals : (n, 3), from central differences."""
    steps = GRADIENT_MM * np.eye(3)
    gradient = [distance_to(body, solids, points + step) - distance_to(body, solids, points - step) for step in steps]
    return np.transpose(gradient) / np.linalg.norm(gradient, axis=0)[:, None]


def reflected(first: tuple, second: tuple, cosine: np.ndarray) -> np.ndarray:
    """Reflected over incident pressure between fluids of (impedance, speed); 1 beyond the critical angle."""
    (z1, c1), (z2, c2) = first, second
    sine2 = (c2 / c1) ** 2 * (1 - cosine**2)
    onwards = np.sqrt(np.maximum(1 - sine2, 0))
    return np.where(sine2 >= 1, 1.0, (z2 * cosine - z1 * onwards) / (z2 * cosine + z1 * onwards))


def follow(body: Body, transducer: Transducer, pose: np.ndarray, steps: int) -> Paths:
    """Follow the lines, step by step."""
    (sx, step), speed, impedance = transducer.scale_mm_per_px, body.column("speed"), body.column("impedance")
    loss = body.column("attenuation") * transducer.frequency_mhz * 2 / 10 / (20 / np.log(10))  # dB/cm, both ways, to nepers a mm
    size = transducer.image_size[0], steps
    found = Paths(step, np.zeros(size, np.uint8), np.zeros(size), np.ones(size), np.zeros(size), np.ones(size), np.ones(size))
    for line in range(size[0]):
        places = rigid.apply(pose, np.column_stack([np.full(steps, sx * line), step * np.arange(steps), np.zeros(steps)]))
        found.labels[line] = labels(body, places)
        slope = 0.0
        for level in range(1, steps):
            here, there = found.labels[line, level - 1 : level + 1].astype(int)
            part, left = 1.0, 1.0
            if here != there:
                solid = np.array([max(here, there) - 1])
                back, ahead = (distance_to(body, solid, places[[n]])[0] for n in (level - 1, level))
                part = np.clip(back / (back - ahead), 0, 1)
                normal = normals(body, solid, places[[level]])[0]
                cosine = normal @ pose[:3, 1]
                square = max(abs(cosine), 0.02)
                left = 1 - reflected((impedance[here], speed[here]), (impedance[there], speed[there]), square) ** 2
                turn = (speed[there] / speed[here] - 1) * -(normal @ pose[:3, 0]) * np.sign(cosine) / square
                slope += np.clip(turn, -0.3, 0.3) if transducer.refraction else 0.0
            slowness = part / speed[here] + (1 - part) / speed[there]
            found.shown_mm[line, level] = found.shown_mm[line, level - 1] + step * transducer.assumed_speed * slowness
            left *= np.exp(-step * (part * loss[here] + (1 - part) * loss[there]))
            found.amplitude[line, level] = found.amplitude[line, level - 1] * left
            found.shift_mm[line, level] = found.shift_mm[line, level - 1] + slope * step
    return found


def shown_labels(paths: Paths, transducer: Transducer) -> np.ndarray:
    """Label of what each pixel shows."""
    lines, depths = paths.shown_mm.shape
    shown = np.empty((transducer.image_size[1], lines), np.uint8)
    for line in range(lines):
        between = (paths.shown_mm[line, :-1] + paths.shown_mm[line, 1:]) / 2
        level = np.clip(np.searchsorted(between, transducer.rows_mm), 0, depths - 1)
        place = np.full(len(level), line)
        for _ in range(3):  # the fixed point `place = line + shift(place)`
            aside = np.rint(line + paths.shift_mm[place, level] / transducer.scale_mm_per_px[0]).astype(int)
            place = np.clip(aside, 0, lines - 1)
        shown[:, line] = paths.labels[place, level]
    return shown


def lay(field: np.ndarray, across: np.ndarray, down: np.ndarray, values: np.ndarray) -> None:
    """Add echoes at fractional places of a field, shared among the four samples around each."""
    i, j = np.floor(across).astype(int), np.floor(down).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < field.shape[0] - 1) & (j < field.shape[1] - 1)
    for right, lower in product((0, 1), (0, 1)):
        part = np.abs(1 - right - (across - i)) * np.abs(1 - lower - (down - j))
        np.add.at(field, (i[inside] + right, j[inside] + lower), (values * part)[inside])


def scatter(body: Body, transducer: Transducer, spread: Beam, paths: Paths, pose: np.ndarray, seed: int) -> np.ndarray:
    """Echoes of the scatterers in the slice."""
    edge, (sx, sy) = transducer.scatterers_per_mm3 ** (-1 / 3), transducer.scale_mm_per_px
    image_from_world = rigid.invert(pose)
    span = np.array(list(product((-3, transducer.width_mm + 3), (-1, 61), (-5, 5))))
    low, high = (np.floor(bound(rigid.apply(pose, span), axis=0) / edge).astype(int) for bound in (np.min, np.max))
    axes = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    near = rigid.apply(image_from_world, (cells + 0.5) * edge)
    cells = cells[(np.abs(near[:, 2]) < 5) & (near[:, 1] > -1) & (near[:, 0] > -3) & (near[:, 0] < transducer.width_mm + 3)]
    bits = np.array([hashed(i, j, k, np.uint64(seed)) for i, j, k in cells], np.uint64)
    parts = np.column_stack([(bits >> np.uint64(21 * axis)) & np.uint64(2**21 - 1) for axis in range(3)]) / 2**21
    places = (cells + parts) * edge
    x, y, z = rigid.apply(image_from_world, places).T
    row = np.clip(np.rint(y / spread.depth_step_mm).astype(int), 0, len(spread.core_mm) - 1)
    kept = (y >= 0) & (y < 58) & (np.abs(z) < spread.core_mm[row]) & (x >= -BESIDE_MM) & (x <= transducer.width_mm + BESIDE_MM)
    x, y, z, row, places = x[kept], y[kept], z[kept], row[kept], places[kept]
    strength = np.sqrt(body.scattering() / transducer.scatterers_per_mm3)[labels(body, places)] * transducer.wavelength_mm
    line = np.clip(np.rint(x / sx).astype(int), 0, transducer.image_size[0] - 1)
    level = (y / sy).astype(int)
    share = y / sy - level
    seen = paths.shown_mm[line, level] * (1 - share) + paths.shown_mm[line, level + 1] * share
    weight = spread.elevation[row, np.rint(np.abs(z) / STEP_MM).astype(int)]
    value = strength * paths.amplitude[line, level] * weight * np.exp(2j * transducer.wavenumber * seen)
    field = field_like(transducer, spread)
    lay(field, (x - paths.shift_mm[line, level]) / sx + spread.lateral.shape[1] // 2, seen / sy * OVERSAMPLING, value)
    return field


def border_echoes(body: Body, transducer: Transducer, spread: Beam, paths: Paths, pose: np.ndarray, seed: int) -> np.ndarray:
    """Echoes of the facets that rays meet, and their repeats: the tissue is looked up in small steps, borders by bisection."""
    (sx, sy), k, field = transducer.scale_mm_per_px, transducer.wavenumber, field_like(transducer, spread)
    lines, depths = paths.labels.shape
    deepest = min(spread.depth_step_mm * (len(spread.core_mm) - 1), paths.step_mm * (depths - 2))
    x, z = (each.ravel() for each in _rays(transducer, spread))
    t = np.arange(0, deepest, MARCH_MM)
    starts, down = rigid.apply(pose, np.column_stack([x, 0 * x, z])), pose[:3, 1]
    found = np.array([labels(body, start + t[:, None] * down) for start in starts])
    ray, level = np.nonzero(np.diff(found, axis=1))
    here, there = found[ray, level], found[ray, level + 1]
    solid, starts, x, z = np.maximum(here, there) - 1, starts[ray], x[ray], z[ray]
    low, high = t[level], t[level + 1]
    sign = np.sign(distance_to(body, solid, starts + low[:, None] * down))
    for _ in range(30):
        middle = (low + high) / 2
        before = np.sign(distance_to(body, solid, starts + middle[:, None] * down)) == sign
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    y, places = low, starts + low[:, None] * down
    normal = normals(body, solid, places) @ pose[:3, :3]
    square = np.abs(normal[:, 1])
    line = np.clip(np.floor(x / sx + 0.5).astype(int), 0, lines - 1)
    step = np.maximum((y / paths.step_mm).astype(int) - 1, 0)
    speed, impedance = body.column("speed"), body.column("impedance")
    seen = paths.shown_mm[line, step] + (y - step * paths.step_mm) * transducer.assumed_speed / speed[here]
    left = paths.amplitude[line, step].astype(float)
    r = reflected((impedance[here], speed[here]), (impedance[there], speed[there]), square)
    straight = (impedance[there] - impedance[here]) / (impedance[there] + impedance[here])
    uneven = 2 * k * body.column("roughness")[solid + 1] * square
    area = sx / SUBLINES * ACROSS_MM
    lambert = np.sqrt(square / np.pi / area) * 2 * np.pi / k
    rough = straight * lambert * np.sqrt(1 - np.exp(-(uneven**2))) * np.exp(1j * patch_phases(places, seed))
    for order in range(1, transducer.reverberations + 2):
        facet = r * np.exp(-0.5 * (order * uneven) ** 2) * unaliased(2 * order * k * normal[:, 0] / square * sx)
        value = facet * unaliased(2 * order * k * normal[:, 2] / square * ACROSS_MM) + (rough if order == 1 else 0)
        value = value * area * left * (r * transducer.face_reflection * left) ** (order - 1)
        row = np.minimum(np.floor(order * y / spread.depth_step_mm + 0.5).astype(int), len(spread.half_mm) - 1)
        kept = (np.abs(z) < spread.half_mm[row]) & (order * seen < field.shape[1] * sy / OVERSAMPLING) & (order * y < deepest)
        kept &= square > 0.05
        echo = value * np.exp(2j * k * order * seen) * spread.elevation[row, np.floor(np.abs(z) / STEP_MM + 0.5).astype(int)]
        bend = paths.shift_mm[line, np.minimum((order * y / paths.step_mm).astype(int), depths - 1)]
        across, below = (x - bend) / sx + spread.lateral.shape[1] // 2, order * seen / sy * OVERSAMPLING
        lay(field, across[kept], below[kept], echo[kept])
    return field


def _rays(transducer: Transducer, spread: Beam) -> list[np.ndarray]:
    sx, width = transducer.scale_mm_per_px[0], transducer.image_size[0]
    beside = int(SUBLINES * BESIDE_MM / sx)
    along = (np.arange(-beside, SUBLINES * width + beside) + 0.5) * sx / SUBLINES - sx / 2
    most = int(spread.half_mm.max() / ACROSS_MM)
    return np.meshgrid(along, ACROSS_MM * np.arange(-most, most + 1), indexing="ij")


def unaliased(phase: np.ndarray) -> np.ndarray:
    """Weight of coherent facets by their phase from line to line."""
    return np.cos(np.pi / 2 * np.clip((np.abs(phase) - TAPER[0]) / (TAPER[1] - TAPER[0]), 0, 1)) ** 2


def patch_phases(places: np.ndarray, seed: int) -> np.ndarray:
    """Phases of rough patches at places : (n, 3)."""
    cells = np.floor(places / PATCH_MM).astype(int)
    return np.array([2 * np.pi * (int(hashed(*cell, np.uint64(seed))) >> 11) / 2**53 for cell in cells])


def wire_echoes(wire: Wire, around: Tissue, transducer: Transducer, spread: Beam, paths: Paths, pose: np.ndarray, seed: int):
    """Echoes of a wire's front and back."""
    (sx, sy), k, field = transducer.scale_mm_per_px, transducer.wavenumber, field_like(transducer, spread)
    length = np.linalg.norm(np.diff(wire.ends, axis=0))
    count = int(length / ALONG_MM)
    share = (np.arange(count)[:, None] + 0.5) / count
    points = wire.ends[0] + share * (wire.ends[1] - wire.ends[0])
    x, y, z = rigid.apply(rigid.invert(pose), points).T
    y = y - wire.radius
    row = np.floor(y / spread.depth_step_mm + 0.5).astype(int)
    kept = (y >= 0) & (np.abs(z) < spread.half_mm[row])
    x, y, z, row, points = x[kept], y[kept], z[kept], row[kept], points[kept]
    line, level = np.clip(np.floor(x / sx + 0.5).astype(int), 0, len(paths.labels) - 1), (y / paths.step_mm).astype(int)
    part = y / paths.step_mm - level
    seen, left = (one[line, level] * (1 - part) + one[line, level + 1] * part for one in (paths.shown_mm, paths.amplitude))
    smooth = np.exp(-0.5 * (2 * k * wire.tissue.roughness) ** 2)
    rise = (wire.ends[1] - wire.ends[0]) @ pose[:3, 1] / count
    value = smooth * np.sinc(k * rise / np.pi) + np.sqrt(1 - smooth**2) * np.exp(1j * patch_phases(points, seed))
    value = value * left * spread.elevation[row, np.floor(np.abs(z) / STEP_MM + 0.5).astype(int)]
    value = value * np.sqrt(wire.radius * transducer.wavelength_mm / 2) * length / count
    bounce = (wire.tissue.impedance - around.impedance) / (wire.tissue.impedance + around.impedance)
    across = (x - paths.shift_mm[line, level]) / sx + spread.lateral.shape[1] // 2
    for n in range(RINGS + 1):
        strength = bounce if n == 0 else -bounce * (1 - bounce**2) * bounce ** (2 * n - 2)
        shown = seen + n * 2 * wire.radius * transducer.assumed_speed / wire.tissue.speed
        lay(field, across, shown / sy * OVERSAMPLING, strength * value * np.exp(2j * k * shown))
    return field


def focused(field: np.ndarray, axial: np.ndarray, lateral: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Field after the pulse, row by row, and after the beam, line by line."""
    taps, half = axial.shape[1] // 2, lateral.shape[1] // 2
    padded = np.pad(field.astype(complex), ((0, 0), (taps, taps)))
    pulsed = [padded[:, OVERSAMPLING * r : OVERSAMPLING * r + 2 * taps + 1] @ axial[r] for r in range(len(axial))]
    near = np.abs(np.arange(-half, half + 1)) <= reach[:, None]
    return np.array([np.correlate(one, np.conj(beam), "valid") for one, beam in zip(pulsed, lateral * near, strict=True)])


def envelope(field: np.ndarray, transducer: Transducer, spread: Beam, focus: np.ndarray) -> np.ndarray:
    """Envelope of several looks, without noise, ringing and clutter, of a focus : (rows, lines)."""
    wide, picture, power = bmode_image.blunt(transducer), transducer.picture, 0.0
    evened = np.sqrt(spread.lateral_energy / wide.lateral_energy)[:, None]
    alike = [
        np.vdot(b, a).real / np.linalg.norm(a) / np.linalg.norm(b) for a, b in zip(spread.lateral, wide.lateral, strict=True)
    ]
    both = np.sqrt(1 + 2 * np.sqrt(focus * (1 - focus)) * np.array(alike)[:, None])
    for band, angle in product(range(picture.bands), range(picture.angles)):
        axial = bmode_image.part_of_band(spread, transducer, band)
        sharp, blurred = (
            focused(field, axial, bmode_image.steered(beam.lateral, transducer, angle), beam.reach) for beam in (spread, wide)
        )
        power = power + np.abs((np.sqrt(focus) * sharp + np.sqrt(1 - focus) * evened * blurred) / both) ** 2
    return bmode_image.gain_over_depth(transducer, spread)[:, None] * np.sqrt(power / picture.bands / picture.angles)
