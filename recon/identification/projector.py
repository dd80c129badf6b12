"""A projector's gamma, point spread, lens and steadiness, from images of a pattern sequence on a still, opaque surface.

A pixel sees `I_n = (1 + gain_n) a P_n(x) + b + offset_n`: the pattern n at its projector coordinate x, behind gamma and all
blurs, with an albedo and an ambient light of its own. These and x are eliminated pixel by pixel (variable projection); what is
left of thousands of pixels tells what all share: how light depends on grey levels, how sharp it is and how that changes with
depth, and how far frames differ from each other. Harmonics tell gamma; edges of bits, and modulations of several pitches, blur.

Light must come from where the projector sends it: skin and other translucent things spread it, and look like a blurred lens.

Sources: Golub and Pereyra 1973 (variable projection); Liang and Zeger 1986 (covariance by clusters); Fuller 1987 (errors in
variables); docs/physics-optics.md.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.estimation.levenberg_marquardt import Descent, Rules, Unreachable, descend
from recon.geometry import rigid
from recon.geometry.camera import Camera, distorted
from recon.identification.estimates import Estimate, Findings
from recon.identification.frame_scatter import NINETY_FIVE, Scatter, scatter
from recon.identification.projected_light import Footprint, mirror_weights
from recon.model.patterns import Axis, Fringes, Patterns, Uniform
from recon.model.rig import ProjectorDevice
from recon.structured_light.decode import ProjectorMap, Status
from recon.structured_light.phase import Noise
from recon.structured_light.triangulate import PointMap

Array = NDArray[np.float64]

SHARED = ("gamma", "blur_px", "aperture_mm", "vergence_per_m", "camera_blur_px")  # of all frames
GAMMA, BLUR, APERTURE, VERGENCE, CAMERA = range(5)
LOWEST = np.array([0.3, 0.0, 0.0, 0.0, 0.0])
HIGHEST = np.array([6.0, 20.0, 60.0, 10.0, 10.0])
START = np.array([2.0, 0.6, 5.0])
SHARPEST = 0.003  # px^2, least variance of all Gaussian blurs together
SPREAD = np.array([1.0, 3.0, 6.0, 1.0])  # standard deviations of a weak prior: wider than projectors differ
BESIDE = 0.5  # 1/m, from the surface's own vergence: where searches for the plane in focus begin
FRAMES = np.array([0.02, 1.0, 0.05])  # standard deviations of gains, offsets in 8-bit DN, and shifts in steps, to begin with
MOST_FRAMES = np.array([0.2, 20.0, 0.2])
LEAST_FRAMES = np.array([1e-5, 1e-3, 1e-5])
LENS = [BLUR, APERTURE, VERGENCE]
SEEN = (  # the whole blur, a part of it, where
    "surface.projector_blur_px",
    "surface.projector_point_spread_px",
    "surface.depth_mm",
)
LENS_ERROR = 1.25  # of their standard deviations: 25 renders of a plane, a sphere and a breast left z-scores of 1.1 to 1.4
LEAST_BLUR_ERROR_PX = 0.01  # the mean error in the same renders, most on the sphere: a pixel's view of what is bent
LOOSE = 5.0  # standard deviations of the decoded coordinate, of a prior around it: it costs a 25th of its information
LEAST_LOOSE_PX = 0.1
LOOSE_ORIGIN = 0.2  # steps, standard deviation of the prior of a set's origin
LONGEST_PX = 0.3  # step of a coordinate
CLEAR = 3.0  # standard deviations of noise, from which on nothing is clipped
DIM = 1.5  # of noise in the dark, from which on what is clipped at 0 adds 3 % of one to the mean: far less than frames' errors
BLIND = 1e-9  # of the best known direction: one that is known less is one that the images can not show
SHIFTS = 2  # among gains, offsets and shifts
FAITHFUL = 1.2  # times the noise, which residuals of a faithful model reach at most
FRINGES = 8  # images, that show frames' errors by themselves
FEW = 1000  # pixels of a search
AT_ONCE = 200  # pixels: slopes of more leave the cache, and of fewer the interpreter takes most of the time
COARSE, FINE = Rules(damping=1e-2, converged=1e-5, steps=25), Rules(converged=1e-7, steps=8)
ODD = 6.0  # times the median of the pixels' mean squares, from which on a pixel loses weight: an edge, a moving thread
ROUNDS = 3  # of weights and of the frames' standard deviations
TOLD = 4.0  # standard deviations of black, from which on there is some
BLACK_ERROR = 1.3  # of its standard deviation: coordinates and frames err, too; 45 computed projectors left z-scores of 1.3
KNOWN_NOISE = 0.1  # relative error of the noise's variance, with what coordinates and frames take from it
DARKEST_GREY = 0.5 / 255  # below, grey levels are black


@dataclass(frozen=True)
class Selection:
    """Pixels that count, and how well a parameter must be known not to be unknown."""

    pixels: int = 6_000
    fewest: int = 500
    window: int = 5  # px, side of the neighbourhood in which the surface must be smooth
    modulation_dn: float = 10.0  # of 255, at least
    place_px: float = 0.2  # projector px, of a coordinate's noise at most: what is not linear in it counts as its square
    steepest: float = 1.5  # slope of a coordinate over the image, in medians: in steep places shading bends what a pixel sees
    blocks: int = 10  # of the image along each side; pixels of a block may err together
    gamma: float = 0.1  # standard deviation at most; displays are set to 1.8 to 2.4
    blur_px: float = 0.1  # lenses blur by 0.3 to 0.8 px
    aperture: float = 0.12  # relative; projectors' lenses are of f/1.7 to f/2.8
    vergence_per_m: float = 0.12  # 50 mm at 650 mm
    total: float = 0.1  # relative, of the whole blur where its parts aren't known
    margin: float = 12.0  # of the cost, by which a focus in front of the surface must differ from one behind it
    modes: float = 3.0  # errors of frames, of which a standard deviation can be taken,
    frames: tuple[float, float, float] = (0.005, 0.3, 0.02)  # or else least sigmas of flicker, stray light in DN, shift in steps


USUAL = Selection()


class CameraBlur(NamedTuple):
    """A camera's blur, all in its own px."""

    blur_px: float  # standard deviation of the point spread in focus
    sigma_px: float  # of that
    aperture_mm: float = 0.0
    focus_mm: float = 1.0


class Along(NamedTuple):
    """What pixels see along one axis of the projector. All (p,)."""

    place: Array  # projector px, decoded
    loose: Array  # projector px, standard deviation of a prior around that
    steepest2: Array  # square of the coordinate's slope over the image, projector px a camera px
    box: Array  # projector px, the wider of a pixel's two sides
    narrow2: Array  # projector px^2, the square of the other one
    magnification: Array  # projector px a unit of x/z


class Pixels(NamedTuple):
    """p sampled pixels."""

    images: Array  # (n, p) DN
    along: dict[Axis, Along]
    vergence: Array  # (p,) 1/m, of the surface's depth before the projector
    defocus2: Array  # (p,) camera px^2, variance of its own disc
    block: NDArray[np.intp]  # (p,)
    uv: NDArray[np.intp]  # (p, 2) px

    def some(self, chosen: NDArray) -> "Pixels":
        """Those chosen."""
        along = {axis: Along(*(values[chosen] for values in one)) for axis, one in self.along.items()}
        return Pixels(
            self.images[:, chosen], along, self.vergence[chosen], self.defocus2[chosen], self.block[chosen], self.uv[chosen]
        )


@dataclass(frozen=True)
class Response:
    """The projector's response as fitted."""

    shared: Array  # (5,) of `SHARED`
    covariance: Array  # (5, 5)
    gains: Array  # (n,)
    offsets: Array  # (n,) DN
    shifts: Array  # (n,) steps; 0 for frames that aren't grey fringes
    flicker: Scatter
    stray: Scatter  # 8-bit DN
    shift: Scatter  # steps
    total_px: Estimate  # blur by the projector's lens, defocus included, at the surface's mean depth
    depth_mm: float  # that depth
    margin: float  # of the cost, by which a focus on the other side of the surface is worse; infinite without such a minimum
    excess: float  # rms of residuals over the noise predicted
    pixels: Pixels
    light: Array  # (n, p) of the patterns alone, 0 to 1
    albedo: Array  # (p,) DN
    ambient: Array  # (p,) DN
    residuals: Array  # (n, p) DN
    noise_dn: Array  # (n, p)


def identify(
    images: NDArray,
    patterns: Patterns,
    found: ProjectorMap,
    points: PointMap,
    devices: tuple[Camera, Camera],
    focal_length_mm: float,
    blur: CameraBlur,
    *,
    bits: int = 8,
    room: NDArray | None = None,
    selection: Selection = USUAL,
) -> Findings:
    """Identify a projector's parameters from a surface capture.

    Parameters
    ----------
    images : (n, h, w) uint8 or uint16, DN
        One an image of the sequence, of an opaque, still surface, by a camera with a linear response.
    patterns : Patterns
    found, points : ProjectorMap, PointMap
        Of these images.
    devices : camera and projector
        As calibrated.
    focal_length_mm : float
        Of the projector's lens, nominal: its aperture is what is measured.
    blur : CameraBlur
        Of the camera.
    room : (h, w) or (m, h, w), DN
        Images with the same exposure and the projector covered; without, the contrast is unknown.

    Raises
    ------
    InputError
        If too few pixels are left, or no fringes place them.
    """
    pixels = sample(images, patterns, found, points, devices, blur, bits, selection)
    response = fit(pixels, patterns, found.noise, blur, bits=bits, selection=selection)
    return findings(response, patterns, focal_length_mm, selection) | contrast(response, room, bits=bits)


def sample(
    images: NDArray,
    patterns: Patterns,
    found: ProjectorMap,
    points: PointMap,
    devices: tuple[Camera, Camera],
    blur: CameraBlur,
    bits: int = 8,
    selection: Selection = USUAL,
) -> Pixels:
    """Choose pixels at random among those that are bright, unclipped and on smooth surfaces, the same ones each time."""
    camera, projector = devices
    coordinates = {"columns": (found.columns, found.sigma_columns), "rows": (found.rows, found.sigma_rows)}
    maps = {axis: (x, sigma) for axis, (x, sigma) in coordinates.items() if x is not None and sigma is not None}
    axes = [axis for axis in patterns.axes if patterns.has_fringes(axis) and axis in maps]
    if axes != list(patterns.axes):
        raise InputError("identify: expected fringes, found Gray code alone, which places pixels to a cell only")
    # By means of windows: pixels whose own noise spares them from being clipped have too bright a dark
    window = (selection.window, selection.window)
    means = np.stack([cv2.blur(image.astype(np.float32), window) for image in images])
    brightest, darkest, noise = means.max(axis=0), means.min(axis=0), found.noise
    good, full = (found.status == Status.OK) & np.isfinite(points.points[..., 2]), 2**bits - 1
    wanted = {
        f"the modulation is below {selection.modulation_dn:g} of 255": found.modulation > selection.modulation_dn * full / 255,
        "bright stripes are saturated": brightest + CLEAR * np.sqrt(noise.read_variance + noise.gain * brightest) < full,
        "dark stripes are at 0, the end of the range": darkest > DIM * np.sqrt(noise.read_variance),
    }
    for axis in axes:
        sigma = np.nan_to_num(maps[axis][1], nan=np.inf)
        known = f"known to {np.median(sigma[good]) if good.any() else np.inf:.2g} px in the median, not to {selection.place_px:g}"
        wanted[f"{axis} are {known}: finer fringes or more steps are needed"] = sigma < selection.place_px
    cause = "nothing was decoded" if np.count_nonzero(good) < selection.fewest else "the surface isn't smooth"
    for reason, those in wanted.items():
        enough = np.count_nonzero(good) >= selection.fewest
        good &= those
        if enough and np.count_nonzero(good) < selection.fewest:
            cause = reason
    inside = cv2.erode(good.astype(np.uint8), np.ones(window, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    v, u = np.nonzero(inside)
    chosen = np.sort(np.random.default_rng(0).permutation(len(v))[: 2 * selection.pixels])
    v, u = v[chosen], u[chosen]
    slopes = {axis: _slopes(maps[axis][0], v, u, selection.window) for axis in axes}
    smooth = np.ones(len(v), bool)
    for axis, (across, down, rest) in slopes.items():
        slope = np.hypot(across, down)
        smooth &= rest < 3 * maps[axis][1][v, u] + 0.1 * slope
        if slope.size:
            smooth &= slope < selection.steepest * np.median(slope)
    kept = np.flatnonzero(smooth)
    kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), selection.pixels)).astype(int)] if kept.size else kept
    if len(kept) < selection.fewest:
        raise InputError(
            f"identify: expected {selection.fewest} pixels of bright fringes on a smooth surface, found {len(kept)}: {cause}"
        )
    v, u = v[kept], u[kept]
    local = rigid.apply(projector.camera_from_world, points.points[v, u].astype(float))
    magnified = dict(zip(("columns", "rows"), _magnifications(projector, local), strict=True))
    along = {}
    for axis, (across, down, _) in slopes.items():
        sides = np.abs(np.stack([across[kept], down[kept]]))
        along[axis] = Along(
            maps[axis][0][v, u].astype(float),
            np.maximum(LOOSE * maps[axis][1][v, u].astype(float), LEAST_LOOSE_PX),
            (sides**2).sum(axis=0),
            sides.max(axis=0),
            sides.min(axis=0) ** 2,
            magnified[axis],
        )
    depth = rigid.apply(camera.camera_from_world, points.points[v, u].astype(float))[:, 2]
    disc = camera.matrix[0, 0] * blur.aperture_mm * np.abs(1 / depth - 1 / blur.focus_mm)
    height, width = found.status.shape
    block = v * selection.blocks // height * selection.blocks + u * selection.blocks // width
    return Pixels(images[:, v, u].astype(float), along, 1e3 / local[:, 2], disc**2 / 16, block, np.stack([u, v], axis=1))


def _slopes(coordinate: NDArray, v: NDArray, u: NDArray, window: int) -> tuple[Array, Array, Array]:
    """Slopes of a map across and down, projector px a px, by planes fitted to windows, and the rms of what planes leave."""
    half = window // 2
    down, across = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    values = coordinate[v[:, None] + down, u[:, None] + across].astype(float)
    design = np.stack([np.ones_like(down), across, down], axis=1).astype(float)
    planes = values @ np.linalg.pinv(design).T
    rest = values - planes @ design.T
    return planes[:, 1], planes[:, 2], np.sqrt((rest**2).sum(axis=1) / (len(design) - 3))


def _magnifications(projector: Camera, local: Array) -> tuple[Array, Array]:
    """Steepest change : (p,) of columns and of rows, px a unit of x/z or y/z, with distortion, at points of its own frame."""
    step, (x, y) = 1e-5, (local[:, :2] / local[:, 2:]).T

    def pixels(dx: float, dy: float) -> Array:
        return projector.to_pixels(np.stack(distorted(x + dx, y + dy, projector.coefficients), axis=-1))

    by_x, by_y = pixels(step, 0) - pixels(-step, 0), pixels(0, step) - pixels(0, -step)
    columns, rows = (np.hypot(by_x[:, k], by_y[:, k]) / (2 * step) for k in range(2))
    return columns, rows


class State(NamedTuple):
    """An estimate."""

    shared: Array  # (5,)
    frames: Array  # (3, n) logarithms of gains, whose mean only scales albedos; offsets in DN; shifts in steps
    places: dict[Axis, Array]  # (p,) projector px


class Step(NamedTuple):
    """A change of it."""

    common: Array  # (s,) of shared parameters and frames
    places: dict[Axis, Array]


class Seen(NamedTuple):
    """What is computed of p pixels at an estimate."""

    light: Array  # (n, p)
    by_place: Array  # (n, p) along the frame's own axis
    by_shared: Array  # (5, n, p)
    by_shift: Array  # (n, p)
    by_bend: Array  # (n, p)


class Reduced(NamedTuple):
    """Normal equations of all that pixels share, after elimination of what they don't."""

    normal: Array  # (s, s)
    right: Array  # (s,)
    own: Array  # (p, q) steps of the pixels' own unknowns if nothing else moves
    by_common: Array  # (p, q, s) and what they lose for each that does


@dataclass(frozen=True)
class System:
    """Normal equations of s numbers that all pixels share, and of q that each has for itself: albedo, ambient, coordinates."""

    normal: Array  # (s, s) with the prior
    right: Array  # (s,)
    inner: Array  # (p, q, q)
    crossed: Array  # (p, q, s)
    pulled: Array  # (p, q)
    axes: tuple[Axis, ...]  # of the last unknowns
    block: NDArray[np.intp]  # (p,)
    block_right: Array  # (blocks, s) of the data alone

    def reduced(self, damping: float = 0.0) -> Reduced:
        """Eliminate the pixels' own unknowns; coordinates with their diagonal times `1 + damping`."""
        inner, size = self.inner.copy(), self.normal.shape[0]
        places = np.arange(2, inner.shape[1])
        inner[:, places, places] *= 1 + damping
        solved = np.linalg.solve(inner, np.concatenate([self.crossed, self.pulled[..., None]], axis=2))
        by_common, own = solved[..., :-1], solved[..., -1]
        flat = self.crossed.reshape(-1, size)
        lost = flat.T @ by_common.reshape(-1, size)
        return Reduced(self.normal - (lost + lost.T) / 2, self.right - flat.T @ own.ravel(), own, by_common)

    def step(self, damping: float) -> Step:
        """Solve with the diagonal times `1 + damping`."""
        reduced = self.reduced(damping)
        common = np.linalg.solve(reduced.normal + damping * np.diag(np.diag(reduced.normal)), reduced.right)
        places = reduced.own - reduced.by_common @ common
        return Step(common, {axis: places[:, 2 + k] for k, axis in enumerate(self.axes)})


@dataclass(frozen=True)
class Model:
    """Pixels, their patterns, and how certain all is beforehand."""

    pixels: Pixels
    patterns: Patterns
    weights: Array  # (n, p) 1/DN^2
    prior: Array  # (5,) of the shared parameters
    prior_sigma: Array  # (5,)
    frame_sigma: Array  # (3,) of gains, offsets in DN, shifts in steps
    rounded_at: Array  # (n,) steps, shifts for which grey levels are rounded

    def of(self, chosen: NDArray) -> "Model":
        """The same for some of the pixels."""
        return replace(self, pixels=self.pixels.some(chosen), weights=self.weights[:, chosen])

    @property
    def frames_used(self) -> list[NDArray[np.intp]]:
        """Frames that have a gain, an offset, a shift."""
        grey = [
            np.arange(place.start, place.stop)
            for part, place in self.patterns.slices()
            if isinstance(part, Fringes) and part.waveform == "sine"
        ]
        every = np.arange(self.patterns.count)
        return [every, every, np.concatenate([*grey, every[:0]])]

    @property
    def sets(self) -> list[NDArray[np.intp]]:
        """Places of the shifts of each set of fringes among all that is shared."""
        first, found = len(SHARED) + 2 * self.patterns.count, []
        for part in self.patterns.parts:
            if isinstance(part, Fringes) and part.waveform == "sine":
                found.append(np.arange(first, first + part.count))
                first += part.count
        return found

    @property
    def precision(self) -> Array:
        """Of the prior : (s, s). The mean shift of a set of fringes is free to 1 px: their origin may be off that of a code."""
        frames = [np.full(len(used), sigma**-2) for used, sigma in zip(self.frames_used, self.frame_sigma, strict=True)]
        found = np.diag(np.concatenate([self.prior_sigma**-2, *frames]))
        for mine in self.sets:
            found[np.ix_(mine, mine)] += (LOOSE_ORIGIN**-2 - self.frame_sigma[2] ** -2) / len(mine)
        return found

    def off_prior(self, state: State) -> Array:
        """Shared parameters and errors of frames : (s,), from where the prior has them."""
        frames = [row[used] for row, used in zip(state.frames, self.frames_used, strict=True)]
        return np.concatenate([state.shared - self.prior, *frames])

    def see(self, state: State, table: "list[Mirrors]", chosen: NDArray | slice = slice(None)) -> Seen:
        """Light of the patterns at pixels, and its slopes; the table is that of the state."""
        _, blur, aperture, vergence, camera_blur = state.shared
        count, off = self.patterns.count, vergence - self.pixels.vergence[chosen]
        shape = (count, len(off))
        seen = Seen(np.empty(shape), np.empty(shape), np.zeros((5, *shape)), np.zeros(shape), np.empty(shape))
        own = camera_blur**2 + self.pixels.defocus2[chosen]
        for axis, one in self.pixels.along.items():
            steepest2, box, narrow2, magnification = (values[chosen] for values in one[2:])
            frames = [k for k, mirrors in enumerate(table) if mirrors.axis == axis]
            per_mm = 1e-3 * magnification * off
            footprint = Footprint(np.maximum(blur**2 + steepest2 * own + narrow2 / 12, SHARPEST), box, aperture * np.abs(per_mm))
            weights = mirror_weights(state.places[axis][chosen], footprint)
            mirrors = weights.first[:, None] + np.arange(weights.value.shape[1])
            length = self.patterns.length(axis)
            dark = (mirrors < 0) | (mirrors >= length)
            mirrors = np.clip(mirrors, 0, length - 1)
            value, by_gamma, by_shift, by_bend = (
                np.where(dark, 0, np.stack([table[k][row] for k in frames])[:, mirrors]) for row in range(1, 5)
            )

            def sums(values: Array, shares: Array) -> Array:
                return np.einsum("npm,pm->np", values, shares)

            by_disc = sums(value, weights.by_disc)
            by_variance = sums(value, weights.by_variance)
            seen.light[frames], seen.by_place[frames] = sums(value, weights.value), sums(value, weights.by_place)
            seen.by_shared[GAMMA, frames], seen.by_shared[BLUR, frames] = sums(by_gamma, weights.value), by_variance * 2 * blur
            seen.by_shared[APERTURE, frames] = by_disc * np.abs(per_mm)
            seen.by_shared[VERGENCE, frames] = by_disc * aperture * 1e-3 * magnification * np.sign(off)
            seen.by_shared[CAMERA, frames] = by_variance * 2 * camera_blur * steepest2
            seen.by_shift[frames], seen.by_bend[frames] = sums(by_shift, weights.value), sums(by_bend, weights.value)
        return seen

    def shade(self, state: State, light: Array, chosen: NDArray | slice = slice(None)) -> tuple[Array, Array]:
        """Albedo and ambient : (p,) DN by weighted least squares, for the light of the patterns : (n, p)."""
        gains, offsets, _ = state.frames
        seen, weights = np.exp(gains)[:, None] * light, self.weights[:, chosen]
        levelled = self.pixels.images[:, chosen] - offsets[:, None]
        total = weights.sum(axis=0)
        middle, level = (weights * seen).sum(axis=0) / total, (weights * levelled).sum(axis=0) / total
        albedo = (weights * (seen - middle) * levelled).sum(axis=0) / (weights * (seen - middle) ** 2).sum(axis=0)
        return albedo, level - albedo * middle

    def show(self, state: State) -> tuple[Array, Array, Array, Array]:
        """The patterns' light : (n, p), albedo and ambient : (p,) DN, and what is expected in the images : (n, p) DN."""
        light = self.see(state, mirrors_of(self.patterns, state.shared[GAMMA], state.frames[2], self.rounded_at)).light
        albedo, ambient = self.shade(state, light)
        return light, albedo, ambient, albedo * np.exp(state.frames[0])[:, None] * light + ambient + state.frames[1][:, None]

    def linearise(self, state: State) -> tuple[System, float]:
        """Normal equations at an estimate, and the cost."""
        system, cost, _ = self.equations(state)
        return system, cost

    def equations(self, state: State, *, bend: bool = False) -> tuple[System, float, float]:
        """The same, and the residuals' squares.

        bend : with one more shared number, the last: that of light = value^(gamma + bend ln value), 0 for a power law
        """
        axes, table = tuple(self.pixels.along), mirrors_of(self.patterns, state.shared[GAMMA], state.frames[2], self.rounded_at)
        precision, off = self.precision, self.off_prior(state)
        size, own_size, count = len(off) + bend, 2 + len(self.pixels.along), self.pixels.images.shape[1]
        blocks, number = np.unique(self.pixels.block, return_inverse=True)
        normal, block_right, squares, cost = np.zeros((size, size)), np.zeros((len(blocks), size)), 0.0, 0.0
        inner, crossed = np.empty((count, own_size, own_size)), np.empty((count, own_size, size))
        pulled, firm = np.empty((count, own_size)), np.zeros((count, own_size))
        firm[:, 2:] = np.stack([self.pixels.along[axis].loose ** -2 for axis in axes], axis=1)
        for chosen in np.array_split(np.argsort(number, kind="stable"), -(-count // AT_ONCE)):
            seen = self.see(state, table, chosen)
            albedo, ambient = self.shade(state, seen.light, chosen)
            bright = albedo * np.exp(state.frames[0])[:, None]
            root = np.sqrt(self.weights[:, chosen])
            rest = root * (self.pixels.images[:, chosen] - bright * seen.light - ambient - state.frames[1][:, None])
            slopes = np.zeros((len(chosen), len(rest), size))
            slopes[:, :, :5] = (bright * seen.by_shared).transpose(2, 1, 0)
            first = len(SHARED)
            of_frames = bright * seen.light, np.ones_like(rest), bright * seen.by_shift
            for used, values in zip(self.frames_used, of_frames, strict=True):
                slopes[:, used, first + np.arange(len(used))] = values[used].T
                first += len(used)
            if bend:
                slopes[:, :, -1] = (bright * seen.by_bend).T
            slopes *= root.T[:, :, None]
            mine = np.empty((len(chosen), len(rest), own_size))
            mine[:, :, 0], mine[:, :, 1] = (root * np.exp(state.frames[0])[:, None] * seen.light).T, root.T
            drawn = np.zeros((len(chosen), own_size))
            for k, axis in enumerate(axes):
                along = np.array([mirrors.axis == axis for mirrors in table])[:, None]
                mine[:, :, 2 + k] = (root * bright * seen.by_place * along).T
                drawn[:, 2 + k] = (self.pixels.along[axis].place - state.places[axis])[chosen]
            back, flat = mine.transpose(0, 2, 1), slopes.reshape(-1, size)
            inner[chosen], crossed[chosen] = back @ mine, back @ slopes
            pulled[chosen] = (back @ rest.T[:, :, None])[..., 0] + firm[chosen] * drawn
            normal += flat.T @ flat
            np.add.at(block_right, number[chosen], np.einsum("pns,np->ps", slopes, rest))
            squares += float((rest**2).sum())
            cost += float((firm[chosen] * drawn**2).sum())
        inner[:, range(own_size), range(own_size)] += firm
        if bend:
            precision, off = np.pad(precision, (0, 1)), np.append(off, 0.0)
        cost += squares + float(off @ precision @ off)
        right = block_right.sum(axis=0) - precision @ off
        system = System(normal + precision, right, inner, crossed, pulled, axes, self.pixels.block, block_right)
        return system, cost, squares

    def move(self, state: State, step: Step) -> State:
        """Take a step, within bounds."""
        if not np.isfinite(step.common).all():
            raise Unreachable
        shared = np.clip(state.shared + step.common[:5], LOWEST, HIGHEST)
        frames, first = state.frames.copy(), 5
        for row, used, most in zip(frames, self.frames_used, (0.5, np.inf, 2.0), strict=True):
            row[used] = np.clip(row[used] + step.common[first : first + len(used)], -most, most)
            first += len(used)
        places = {
            axis: place + np.clip(np.nan_to_num(step.places[axis]), -LONGEST_PX, LONGEST_PX)
            for axis, place in state.places.items()
        }
        return State(shared, frames, places)


class Mirrors(NamedTuple):
    """A frame on the projector's raster, along the axis on which it varies. All (length,)."""

    axis: Axis
    light: Array  # 0 to 1
    by_gamma: Array
    by_shift: Array  # a step
    by_bend: Array


def mirrors_of(patterns: Patterns, gamma: float, shifts: Array, rounded_at: Array) -> list[Mirrors]:
    """The frames' mirrors for a gamma and the frames' shifts : (n,) in steps: grey levels pass gamma, binary ones need none.

    Levels are rounded to 8 bits as for the shifts `rounded_at` : (n,), so that a fit sees no jumps.
    """
    table = []
    for part, place in patterns.slices():
        length = patterns.length(part.axis)
        none, profiles = np.zeros(length), part.profiles(length).astype(float)
        sine = isinstance(part, Fringes) and part.waveform == "sine"
        for levels, k in zip(profiles, range(place.start, place.stop), strict=True):
            if not sine and not isinstance(part, Uniform):
                table.append(Mirrors(part.axis, levels, none, none, none))
                continue
            turning = none
            if isinstance(part, Fringes):
                turn = 2 * np.pi / part.steps
                phase = 2 * np.pi * (np.arange(length) - part.zero(length)) / part.pitch
                phase += part.shifts[k - place.start]
                levels = (1 + np.cos(phase + turn * rounded_at[k])) / 2
                late, turning = (1 + np.cos(phase + turn * shifts[k])) / 2, -turn * np.sin(phase + turn * shifts[k]) / 2
                shown = np.round(levels * 255) / 255 + late - levels
            else:
                shown = np.round(levels * 255) / 255
            floored = np.maximum(shown, DARKEST_GREY)
            light, log = np.where(shown > DARKEST_GREY, floored**gamma, 0), np.log(floored)
            steep = gamma * floored ** (gamma - 1)
            table.append(Mirrors(part.axis, light, light * log, steep * turning, light * log**2))
    return table


def fit(
    pixels: Pixels, patterns: Patterns, noise: Noise, blur: CameraBlur, *, bits: int = 8, selection: Selection = USUAL
) -> Response:
    """Fit the response to sampled pixels.

    Weights are those of the model's own intensities, as weights by noisy ones would pull the fit to the dark. The plane in focus
    is looked for on both sides of the surface. The covariance is that of scores summed over blocks of the image: what the model
    can't explain errs together in a block. It holds for light that is nearly a power of grey levels: bent by a number that isn't
    known either, which makes gamma twice as uncertain as a power would be.
    """
    unit = np.array([1, 2.0 ** (bits - 8), 1])
    middle = float(pixels.vergence.mean())
    prior = np.array([*START, middle, blur.blur_px])
    sigma = np.append(SPREAD, max(blur.sigma_px, 1e-4))
    level = noise.read_variance + noise.gain * np.maximum(pixels.images.mean(axis=0), 0)
    weights = np.broadcast_to(1 / level, pixels.images.shape)
    model = Model(pixels, patterns, weights, prior, sigma, FRAMES * unit, np.zeros(patterns.count))
    few = np.arange(0, len(pixels.block), max(1, len(pixels.block) // FEW))
    sides = []
    for away in (BESIDE, -BESIDE):
        shared = np.array([*START, middle + away, blur.blur_px])
        start = State(shared, np.zeros((3, patterns.count)), _decoded(model.pixels.some(few)))
        sides.append(_descended(model.of(few), start, COARSE).estimate)
    sides.sort(key=lambda side: model.of(few).linearise(side)[1])
    state, scatters, frame_sigma = State(sides[0].shared, sides[0].frames, _decoded(pixels)), [], model.frame_sigma
    for _ in range(ROUNDS):
        state, system, *_ = _descended(model, state, FINE)
        *_, shown = model.show(state)
        excess2 = (model.weights * (pixels.images - shown) ** 2).sum() / (shown.size - system.pulled.size)
        scatters = _scatters(model, state, system, unit, excess2)
        if excess2 < FAITHFUL**2:
            frame_sigma = np.maximum([one.value for one in scatters], LEAST_FRAMES) * unit
        weights = 1 / (noise.read_variance + noise.gain * np.maximum(shown, 0))
        squares = (weights * (pixels.images - shown) ** 2).mean(axis=0)
        model = replace(
            model,
            weights=weights * np.minimum(1, ODD * np.median(squares) / np.maximum(squares, 1e-12)),
            frame_sigma=frame_sigma,
            rounded_at=state.frames[2],
        )
    state, *_ = _descended(model, state, FINE)
    grey = any(mirrors.by_gamma.any() for mirrors in mirrors_of(patterns, 2.0, state.frames[2], state.frames[2]))
    system, _, squares = model.equations(state, bend=grey)
    reduced = system.reduced()
    free = pixels.images.size - reduced.own.size - len(reduced.right)
    precision = np.pad(model.precision, (0, 1)) if grey else model.precision
    covariance = _by_blocks(system, reduced, precision)
    covariance[np.ix_(LENS, LENS)] *= LENS_ERROR**2
    covariance[BLUR, BLUR] += LEAST_BLUR_ERROR_PX**2
    light, albedo, ambient, shown = model.show(state)
    excess = float(np.sqrt(squares / free))
    return Response(
        shared=state.shared,
        covariance=covariance[:5, :5],
        gains=np.expm1(state.frames[0]),
        offsets=state.frames[1],
        shifts=state.frames[2],
        flicker=scatters[0],
        stray=scatters[1],
        shift=scatters[2],
        total_px=_total(pixels, state.shared, covariance[:5, :5]),
        depth_mm=1e3 / middle,
        margin=_margin(model, few, state, sides[1]) / excess**2,
        excess=excess,
        pixels=pixels,
        light=light,
        albedo=albedo,
        ambient=ambient,
        residuals=pixels.images - shown,
        noise_dn=1 / np.sqrt(model.weights),
    )


def _descended(model: Model, start: State, rules: Rules) -> Descent[State, System, Step]:
    return descend(start, model.linearise, model.move, rules=rules)


def _decoded(pixels: Pixels) -> dict[Axis, Array]:
    """Coordinates to begin with."""
    return {axis: one.place for axis, one in pixels.along.items()}


def _scatters(model: Model, state: State, system: System, unit: Array, excess2: float) -> list[Scatter]:
    """Standard deviations of the frames' gains, offsets in 8-bit DN, and shifts in steps.

    The mean shift of a set is its origin's. Where the model leaves much, light spreads farther than blur does, and binary images
    differ by that: only differences within sets of fringes count.
    """
    found, first, off, normal = [], len(SHARED), model.off_prior(state), system.reduced().normal
    precision, places = model.precision, [places - model.sets[0][0] for places in model.sets]
    grey = model.frames_used[2]
    for number, (used, most, one) in enumerate(zip(model.frames_used, MOST_FRAMES, unit, strict=True)):
        if not len(used):
            found.append(Scatter(0.0, np.inf, 0.0))
            continue
        mine = np.arange(first, first + len(used))
        first += len(used)
        others = np.setdiff1d(np.arange(len(normal)), mine)
        crossed = normal[np.ix_(mine, others)]
        marginal = normal[np.ix_(mine, mine)] - crossed @ np.linalg.solve(normal[np.ix_(others, others)], crossed.T)
        information, pull = marginal - precision[np.ix_(mine, mine)], marginal @ off[mine]
        odd = excess2 > FAITHFUL**2 and len(grey) >= FRINGES
        if number == SHIFTS or odd:
            means = [np.isin(used, grey[mean]).astype(float) for mean in places]
            alone = [np.eye(len(used))[k] for k in range(len(used)) if used[k] not in grey]
            loaded = information @ (free := np.array(means + alone).T)
            solve = np.linalg.pinv(free.T @ loaded, rcond=BLIND, hermitian=True)
            information, pull = information - loaded @ solve @ loaded.T, pull - loaded @ solve @ (free.T @ pull)
        found.append(scatter(information * one**2 / excess2, pull * one / excess2, most))
    return found


def _by_blocks(system: System, reduced: Reduced, precision: Array) -> Array:
    """Covariance of all that is shared, by the scatter of the blocks' scores and the prior."""
    scores = system.block_right.copy()
    np.subtract.at(scores, np.unique(system.block, return_inverse=True)[1], np.einsum("pqs,pq->ps", system.crossed, reduced.own))
    off, blocks = scores - scores.mean(axis=0), len(scores)
    inverse = np.linalg.inv(reduced.normal)
    return inverse @ (off.T @ off * blocks / (blocks - 1) + precision) @ inverse


def _total(pixels: Pixels, shared: Array, covariance: Array) -> Estimate:
    """Standard deviation of the projector's whole blur at the surface, disc and all, in projector px."""
    magnification = next(iter(pixels.along.values())).magnification * 1e-3
    off, aperture = shared[VERGENCE] - pixels.vergence, shared[APERTURE]
    total = float(np.mean(shared[BLUR] ** 2 + (aperture * magnification * off) ** 2 / 16))
    slope = np.zeros(len(SHARED))
    slope[BLUR] = 2 * shared[BLUR]
    slope[APERTURE] = np.mean(aperture * (magnification * off) ** 2 / 8)
    slope[VERGENCE] = np.mean((aperture * magnification) ** 2 * off / 8)
    sigma = np.sqrt(max(slope @ covariance @ slope, 0.0) / total) / 2 if total else np.inf
    return Estimate(float(np.sqrt(total)), float(sigma), "the fit")


def _margin(model: Model, few: NDArray, state: State, other: State) -> float:
    """Cost of a focus on the other side of the surface, above that of the one found; infinite where there is no such minimum."""
    small = model.of(few)
    here = State(state.shared, state.frames, {axis: place[few] for axis, place in state.places.items()})
    here, there = (_descended(small, one, COARSE).estimate for one in (here, other))
    middle = float(model.pixels.vergence.mean())
    if (here.shared[VERGENCE] - middle) * (there.shared[VERGENCE] - middle) > 0:
        return np.inf
    return (small.linearise(there)[1] - small.linearise(here)[1]) * model.pixels.images.shape[1] / len(few)


def findings(response: Response, patterns: Patterns, focal_length_mm: float, selection: Selection = USUAL) -> Findings:
    """The fitted parameters by their fields' names; those that the images show too weakly are unknown."""
    source = f"{patterns.count} images of a surface at {response.depth_mm:.0f} mm"
    sigma = np.sqrt(np.diag(response.covariance))
    estimates: dict[str, Estimate] = {}
    unknown = {"projector.lens.vignetting": "the surface's reflectance isn't known"}
    shared = response.shared
    if sigma[GAMMA] < selection.gamma:
        estimates["projector.gamma"] = Estimate(float(shared[GAMMA]), float(sigma[GAMMA]), source)
    else:
        unknown["projector.gamma"] = f"its standard deviation is {sigma[GAMMA]:.2g}: few grey levels, if any, show it"
    known = (
        response.margin > selection.margin
        and sigma[APERTURE] < selection.aperture * shared[APERTURE]
        and sigma[VERGENCE] < selection.vergence_per_m
        and sigma[BLUR] < selection.blur_px
    )
    if known:
        number, focus = focal_length_mm / shared[APERTURE], 1e3 / shared[VERGENCE]
        estimates["projector.lens.blur_px"] = Estimate(float(shared[BLUR]), float(sigma[BLUR]), source)
        by_aperture, by_vergence = number / shared[APERTURE] * sigma[APERTURE], focus**2 / 1e3 * sigma[VERGENCE]
        estimates["projector.lens.f_number"] = Estimate(float(number), float(by_aperture), source)
        estimates["projector.lens.focus_mm"] = Estimate(float(focus), float(by_vergence), source)
    else:
        total = response.total_px
        why = (
            f"only its sum with defocus shows, {total.value:.3f} +- {total.sigma:.3f} px at {response.depth_mm:.0f} mm: "
            "a surface with more depth parts them"
        )
        unknown |= {f"projector.lens.{name}": why for name in ("blur_px", "f_number", "focus_mm")}
        if total.sigma < selection.total * total.value:
            part = Estimate(float(min(shared[BLUR], total.value)), float(sigma[BLUR]), source)
            estimates |= dict(zip(SEEN, (total, part, Estimate(response.depth_mm, 0.0, source)), strict=True))
    scatters = {"flicker": response.flicker, "stray_dn": response.stray, "shift": response.shift}
    for (name, one), usual in zip(scatters.items(), selection.frames, strict=True):
        if one.modes > selection.modes or one.sigma < usual:
            estimates[f"conditions.frames.{name}"] = Estimate(one.value, one.sigma, f"differences of {source}")
        else:
            unknown[f"conditions.frames.{name}"] = f"its standard deviation is {one.sigma:.2g}: too few frames show it"
    return Findings(estimates, unknown)


def with_blur_as_seen(device: ProjectorDevice, found: Findings) -> ProjectorDevice:
    """A projector whose lens isn't measured, but its whole blur at a surface, so that it blurs as much there.

    It is taken as focused nearer than the surface, with its aperture as it is assumed; no images tell.
    """
    if not found.estimates.keys() >= set(SEEN):
        return device
    lens, (total, part, depth) = device.lens, (found.estimates[name].value for name in SEEN)
    disc = 4 * np.sqrt(max(total**2 - part**2, 0.0))
    nearer = disc / (device.optics.focal_px[0] * lens.aperture_mm)
    focused = {"blur_px": part, "focus_mm": float(1 / (1 / depth + nearer))}
    return device.model_copy(update={"lens": lens.model_copy(update=focused)})


def contrast(response: Response, room: NDArray | None, *, bits: int = 8) -> Findings:
    """Contrast C of full on to full off, by the black of `black`, which is `1 / (C - 1)` of the patterns' share.

    The estimate is the middle of the interval of 95 %, which is skewed. Without images of the room it is unknown.
    """
    name = "projector.contrast"
    if room is None:
        most = float(np.quantile(response.ambient / response.albedo, 0.05))
        why = f"black and room light add up, so that it is {_least(most)} or more; images with the projector covered part them"
        return Findings(unknown={name: why})
    ratio, sigma = black(response, room, bits=bits)
    if ratio < TOLD * sigma:
        why = f"black isn't told from stray light and noise, so that it is {_least(max(ratio, 0) + 2 * sigma)} or more"
        return Findings(unknown={name: why})
    least, most = 1 / (ratio + NINETY_FIVE * sigma), 1 / (ratio - NINETY_FIVE * sigma)
    source = "the surface with the projector on black, and covered"
    return Findings({name: Estimate(1 + (least + most) / 2, (most - least) / (2 * NINETY_FIVE), source)})


def black(response: Response, room: NDArray, *, bits: int = 8) -> tuple[float, float]:
    """The projector's black as a share of the patterns' light, and its standard deviation.

    Stray light of the frames is the same in all pixels, whereas black goes with the albedo. Noise of albedo and ambient light,
    which the same images show, is correlated; its variances are taken off the sums [Fuller 1987].

    room : (h, w) or (m, h, w), DN, with the projector covered.
    """
    u, v = response.pixels.uv.T
    frames = np.asarray(room, float).reshape(-1, *np.shape(room)[-2:])[:, v, u]
    albedo, dark = response.albedo, response.ambient - frames.mean(axis=0)
    seen, weights = (1 + response.gains)[:, None] * response.light, (response.excess * response.noise_dn) ** -2.0
    one, once, twice = ((weights * seen**power).sum(axis=0) for power in range(3))
    determinant = one * twice - once**2
    own, shared = float((one / determinant).sum()), float((-once / determinant).sum())
    products = np.array([[(albedo**2).sum() - own, albedo.sum()], [albedo.sum(), len(albedo)]])
    sums = np.array([(albedo * dark).sum() - shared, dark.sum()])
    ratio, offset = np.linalg.solve(products, sums)
    variance = np.mean((dark - ratio * albedo - offset) ** 2)
    stray = max(response.stray.value * 2.0 ** (bits - 8), LEAST_FRAMES[1])
    products[1, 1] += variance / (stray**2 * (1 / len(frames) + 1 / len(seen)))
    inverse = np.linalg.inv(products)
    sigma = np.hypot(np.sqrt(variance * inverse[0, 0]), KNOWN_NOISE * shared * inverse[0, 0])
    return float((inverse @ sums)[0]), BLACK_ERROR * float(sigma)


def _least(most: float) -> str:
    """The contrast of the most that black can be."""
    return f"{1 + 1 / max(most, 1e-4):.0f}"
