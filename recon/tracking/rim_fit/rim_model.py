"""The fit of a ring's outer rim to the pixels beside it, compiled.

The band of pixels about the rim is modelled as the image of an elliptical edge: dark inside, bright outside, each side a plane
and what `own_levels` adds to it, blurred by the lens (Gaussian) and by motion (a box along one direction), which together are
three numbers, the variance of the profile across the edge as it turns with the normal: `V = v0 + v1 cos 2phi + v2 sin 2phi`.
Motion by b px along psi makes the profile a box of width `b |cos(phi - psi)|`; along the edge it pulls the rim inwards by
`curvature (b sin(phi - psi))^2 / 24`. The white middle is part of the model as far as it blurs into the band.

Fourteen parameters, Gauss-Newton. The pixels of a sector share their derivatives but for five (where the edge lies, both levels,
the variance, how light grows), so sums of five unknowns a sector are all that the loop over pixels makes. Sectors that look
otherwise (a finger, a cable, the image's border) lose their weight. The noise is told from the residuals, apart for the dark and
the bright side.
"""

import math

import numpy as np
from numba import prange

from recon.compiled import njit
from recon.tracking.rim_fit import sector_levels
from recon.tracking.rim_fit.cholesky import solve_and_invert
from recon.tracking.rim_fit.edge_profile import blurred_step
from recon.tracking.rim_fit.sector_levels import COMMON, NONE, REDUCED
from recon.tracking.rim_fit.sectors import (
    BLUR,
    BOX,
    BRIGHT,
    BRIGHT2,
    BRIGHT_SQUARES,
    COS,
    COUNT,
    DARK,
    DARK2,
    DARK_SQUARES,
    GROWTH,
    INNER,
    LEANING,
    LEAST_SECTORS,
    LEAST_VARIANCE,
    LOCAL,
    MIXED,
    NX,
    NY,
    OUTER,
    OUTERMOST,
    OWN,
    PULL,
    RIGHT,
    ROUNDING,
    SCATTER,
    SECTORS,
    SIN,
    SQUARES,
    UX,
    UY,
    WIDE,
    X,
    Y,
    geometry,
    judge,
    sector,
    steep,
)

STARTS = (0, 5, 8, 11, 14)  # of the parameters of offset, inside, outside, variance
GLOBAL = 14  # centre (2), shape (3), planes inside (3) and outside (3), variance (3)
CAPTURE_STEPS = 8  # on every second pixel of every second row, from a rough ellipse
STEPS = 8  # on all pixels
TOLD = 3  # steps after which spreads stay as they are, so that the rest may settle
CAPTURED = 0.1  # px
SETTLED = 4e-3  # px; the step after that is a tenth of it
RESTLESS = 0.2  # px of the last step: a fit that still moves so has found nothing
FAST = {"reassoc", "contract", "arcp", "nsz"}  # all but what is not finite
FEWEST = 4  # pixels of a sector that count

# what a fit returns, by column
CENTRE, SHAPE, COVARIANCE, INSIDE, OUTSIDE, NOISE, VARIANCE, SEEN = 0, 2, 5, 30, 31, 32, 34, 37
EXCESS, MIDDLE, FAILED, UNEVEN, COLUMNS = 38, 39, 40, 41, 42


@njit(parallel=True, error_model="numpy")
def fit_rims(first, second, of_second, centres, shapes, reach, known, hole):
    """Fit n rims : (n, COLUMNS), each in one of two images of one type, from rough ellipses that may be off by reach : (n,) px.

    `known` : (n,) px, the standard deviation that shapes are known with before; inf if they aren't. `hole` is the inner over the
    outer diameter.
    """
    result = np.full((len(centres), COLUMNS), np.nan)
    for i in prange(len(centres)):
        _fit(second if of_second[i] else first, centres[i], shapes[i], reach[i], known[i], hole, result[i])
    return result


@njit(error_model="numpy")
def _fit(image, centre, shape, reach, known, hole, result):
    ellipse = np.array([centre[0], centre[1], shape[0, 0], shape[0, 1], shape[1, 1]])
    before = ellipse.copy()
    result[FAILED] = 1
    if not _sound(ellipse, image.shape):
        return
    variance = np.array([(reach / 2.5) ** 2 + 0.25, 0.0, 0.0])
    planes, noise, weights = np.zeros(6), np.ones(2), np.ones(SECTORS)
    if not _first_levels(image, ellipse, variance, reach, hole, planes, noise):
        return
    own, spread = np.zeros((SECTORS, OWN)), np.full(3, NONE)
    sums, reduced, follow = np.zeros((SECTORS, LOCAL)), np.zeros((SECTORS, REDUCED)), np.zeros((SECTORS, 3, COMMON + 1))
    step, inverse, slopes = np.zeros(GLOBAL), np.zeros((GLOBAL, GLOBAL)), np.ones((SECTORS, GLOBAL))
    moved = np.inf
    for capture in (True, False):
        stride = 2 if capture and ellipse[2] + ellipse[4] > 40 else 1
        for k in range(CAPTURE_STEPS if capture else STEPS):
            sectors = geometry(ellipse, variance, reach if capture else 0.0, hole)
            _add_up(image, ellipse, planes, own, noise, sectors, stride, hole, sums)
            if not judge(sums, sectors, planes, own, weights, noise, capture, FEWEST if stride == 1 else 1):
                return
            if not capture and k < TOLD:
                sector_levels.tell_spread(sums, own, weights, math.pi * (ellipse[2] + ellipse[4]) / SECTORS, spread)
            sector_levels.eliminate(sums, own, spread, reduced, follow)
            _slopes(sectors, slopes)
            if not _solve(reduced, weights, slopes, planes, before - ellipse, known, step, inverse):
                return
            _move(ellipse, planes, variance, step, reach)
            sector_levels.move(own, follow, _by_sector(slopes, step), weights)
            if not _sound(ellipse, image.shape):
                return
            moved = np.abs(step[:5]).max()
            if moved < (CAPTURED if capture else SETTLED) and (capture or k > 0):  # growth is told from the second step on
                break
    if not moved < RESTLESS:
        return
    freedom = max(weights.sum() - 6, 1.0)
    scores = 0.0
    for j in range(SECTORS):
        if reduced[j, 0] > 0:
            scores += weights[j] * reduced[j, REDUCED - COMMON] ** 2 / reduced[j, 0]
    result[CENTRE : CENTRE + 5] = ellipse
    result[COVARIANCE : COVARIANCE + 25] = inverse[:5, :5].copy().ravel()
    result[INSIDE], result[OUTSIDE] = planes[0], planes[3]
    result[NOISE : NOISE + 2] = np.sqrt(noise)
    result[VARIANCE : VARIANCE + 3] = variance
    result[SEEN] = (weights > 0.5).sum() / SECTORS
    result[EXCESS] = scores / freedom
    result[MIDDLE] = _middle(image, ellipse, hole)
    result[UNEVEN] = spread[BRIGHT]
    result[FAILED] = 0


@njit(error_model="numpy")
def _sound(ellipse, size):
    """Whether the numbers are those of an ellipse whose middle is in the image."""
    if not np.isfinite(ellipse).all():
        return False
    half, gap = (ellipse[2] + ellipse[4]) / 2, math.hypot((ellipse[2] - ellipse[4]) / 2, ellipse[3])
    if half - gap < 3 or half - gap < 0.2 * (half + gap) or half + gap > max(size):
        return False
    return -1 < ellipse[0] < size[1] and -1 < ellipse[1] < size[0]


@njit(inline="always", error_model="numpy")
def _window(ellipse, beyond, size):
    """Rows and columns that hold the ellipse and what is around it by a share of its size."""
    half_x, half_y = beyond * math.hypot(ellipse[2], ellipse[3]), beyond * math.hypot(ellipse[3], ellipse[4])
    left, right = max(int(ellipse[0] - half_x), 0), min(int(ellipse[0] + half_x) + 2, size[1])
    return left, right, max(int(ellipse[1] - half_y), 0), min(int(ellipse[1] + half_y) + 2, size[0])


@njit(error_model="numpy", fastmath=FAST)
def _add_up(image, ellipse, planes, own, noise, sectors, stride, hole, sums):
    """Fill the sums of all sectors: measured less modelled, and the model's slopes."""
    sums[:] = 0
    a, b, c = ellipse[2], ellipse[3], ellipse[4]
    determinant = a * c - b * b
    ia, ib, ic = c / determinant, -b / determinant, a / determinant
    radius, ratio = (a + c) / 2, min(max(planes[0] / max(planes[3], 1.0), 0.0), 1.0)  # ratio of light on ink and on paper
    shortest = radius - math.hypot((a - c) / 2, b)
    lowest = max(1 - sectors[:, INNER].max() * 1.2 / shortest, 1 - 0.85 * (1 - hole)) ** 2
    highest = min(1 + sectors[:, OUTER].max() * 1.2 / shortest, 1 + OUTERMOST)
    left, right, top, bottom = _window(ellipse, highest, image.shape)
    highest = highest * highest
    flat, lean, rest = ia * ia + ib * ib, ib * (ia + ic), ib * ib + ic * ic
    for v in range(top, bottom, stride):
        y = v - ellipse[1]
        middle = ellipse[0] - lean * y / flat
        beyond = (rest - lean * lean / flat) * y * y
        if beyond >= highest:
            continue
        half = math.sqrt((highest - beyond) / flat)
        empty = math.sqrt((lowest - beyond) / flat) if beyond < lowest else 0.0
        u = max(left, int(middle - half) + 1) - stride
        last = min(right - 1, int(middle + half))
        while u + stride <= last:
            u += stride
            if abs(u - middle) < empty - 1:
                u += int((middle + empty - 1 - u) / stride) * stride
            x = u - ellipse[0]
            p, q = ia * x + ib * y, ib * x + ic * y
            square = p * p + q * q
            if square < lowest or square > highest:
                continue
            away = math.sqrt(square)
            p, q = p / away, q / away
            at = sector(p, q)
            j = int(at)
            sx, sy = ia * p + ib * q, ib * p + ic * q
            slope2 = sx * sx + sy * sy
            slope = math.sqrt(slope2)
            distance = (away - 1) / slope
            turn = p * (ib * sx + ic * sy) - q * (ia * sx + ib * sy)
            distance += turn * turn * distance * distance / (away * slope2 * 2 * slope)
            if distance < -sectors[j, INNER] or distance > sectors[j, OUTER]:
                continue
            distance += sectors[j, PULL]
            wide = sectors[j, WIDE]
            share, peak = blurred_step(distance, sectors[j, BOX], sectors[j, BLUR], wide)
            bright = share
            within = (away - hole) / slope
            if hole > 0 and within * within < 16 * wide + sectors[j, BOX] ** 2 / 4:
                bright += 1 - blurred_step(within, sectors[j, BOX], sectors[j, BLUR], wide)[0]
            xr, yr = x / radius, y / radius
            inside = planes[0] + planes[1] * xr + planes[2] * yr + own[j, DARK]
            outside = planes[3] + planes[4] * xr + planes[5] * yr + own[j, BRIGHT]
            step = outside - inside
            bent = wide * peak  # by which light that grows is more, blurred with the edge
            even = ratio + (1 - ratio) * bright
            growth = distance * even + bent * (1 - ratio)
            residual = image[v, u] - inside - step * bright - own[j, GROWTH] * growth - own[j, LEANING] * (at - j - 0.5) * even
            residual -= bent * ((planes[4] - planes[1]) * sectors[j, NX] + (planes[5] - planes[2]) * sectors[j, NY]) / radius
            share = min(bright, 1.0)
            expected = noise[0] + (noise[1] - noise[0]) * share
            squared = residual * residual
            robust = 1 / (1 + squared / (SCATTER * SCATTER * expected)) ** 2
            w = robust / expected
            c0, c1, c2, c4 = -step * peak, 1 - bright, bright, growth
            c3 = c0 * distance / (2 * wide)
            row = sums[j]
            row[0] += w * c0 * c0
            row[1] += w * c0 * c1
            row[2] += w * c0 * c2
            row[3] += w * c0 * c3
            row[4] += w * c0 * c4
            row[5] += w * c1 * c1
            row[6] += w * c1 * c2
            row[7] += w * c1 * c3
            row[8] += w * c1 * c4
            row[9] += w * c2 * c2
            row[10] += w * c2 * c3
            row[11] += w * c2 * c4
            row[12] += w * c3 * c3
            row[13] += w * c3 * c4
            row[14] += w * c4 * c4
            row[RIGHT] += w * c0 * residual
            row[RIGHT + 1] += w * c1 * residual
            row[RIGHT + 2] += w * c2 * residual
            row[RIGHT + 3] += w * c3 * residual
            row[RIGHT + 4] += w * c4 * residual
            row[SQUARES] += w * squared
            row[COUNT] += robust
            row[DARK2] += robust * (1 - share) * (1 - share)
            row[MIXED] += robust * (1 - share) * share
            row[BRIGHT2] += robust * share * share
            row[DARK_SQUARES] += robust * (1 - share) * squared
            row[BRIGHT_SQUARES] += robust * share * squared


@njit(error_model="numpy")
def _slopes(sectors, slopes):
    """How each sector's edge, levels and variance follow the parameters : (SECTORS, GLOBAL), in the order of STARTS."""
    for j in range(SECTORS):
        ux, uy, nx, ny = sectors[j, UX], sectors[j, UY], sectors[j, NX], sectors[j, NY]
        slopes[j, 0], slopes[j, 1], slopes[j, 2], slopes[j, 3], slopes[j, 4] = nx, ny, nx * ux, nx * uy + ny * ux, ny * uy
        slopes[j, 6], slopes[j, 7] = sectors[j, X], sectors[j, Y]
        slopes[j, 9], slopes[j, 10] = sectors[j, X], sectors[j, Y]
        slopes[j, 12], slopes[j, 13] = sectors[j, COS], sectors[j, SIN]


@njit(error_model="numpy")
def _by_sector(slopes, step):
    """A step of the parameters as each sector sees it : (SECTORS, COMMON)."""
    steps = np.zeros((SECTORS, COMMON))
    for m in range(COMMON):
        for p in range(STARTS[m], STARTS[m + 1]):
            steps[:, m] += slopes[:, p] * step[p]
    return steps


@njit(error_model="numpy")
def _solve(reduced, weights, slopes, planes, back, sigma, step, inverse):
    """The step : (14,) and the inverse of the normal matrix : (14, 14); False if they are undetermined.

    `back` : (5,) px is the way to the ellipse as it was before, `sigma` the standard deviation that its shape is known with.
    """
    normal, right = np.zeros((GLOBAL, GLOBAL)), np.zeros(GLOBAL)
    for j in range(SECTORS):
        if weights[j] < 1e-6:
            continue
        k = 0
        for m in range(COMMON):
            for n in range(m, COMMON):
                known = weights[j] * reduced[j, k]
                k += 1
                for p in range(STARTS[m], STARTS[m + 1]):
                    for q in range(max(STARTS[n], p), STARTS[n + 1]):
                        normal[p, q] += known * slopes[j, p] * slopes[j, q]
        for m in range(COMMON):
            for p in range(STARTS[m], STARTS[m + 1]):
                right[p] += weights[j] * reduced[j, k + m] * slopes[j, p]
    for p in range(GLOBAL):
        for q in range(p):
            normal[p, q] = normal[q, p]
    for k in (2, 3, 4):
        normal[k, k] += 1 / sigma**2
        right[k] += back[k] / sigma**2
    level = (planes[3] - planes[0]) ** 2 + 1
    for k in (6, 7, 9, 10):  # light hardly doubles from one side of a ring to the other
        normal[k, k] += 4 / level
        right[k] -= 4 / level * planes[k - 5]
    for k in range(GLOBAL):
        normal[k, k] += 1e-10 * normal[k, k] + 1e-12
    return solve_and_invert(normal, right, step, inverse)


@njit(error_model="numpy")
def _move(ellipse, planes, variance, step, reach):
    """Move the parameters; shortens the step to what they did."""
    shortest = (ellipse[2] + ellipse[4]) / 2 - math.hypot((ellipse[2] - ellipse[4]) / 2, ellipse[3])
    limit = min(max(reach, 1.0), 0.3 * shortest)
    step[:5] *= min(1.0, limit / max(np.abs(step[:5]).max(), 1e-12))
    ellipse += step[:5]
    planes += step[5:11]
    before = variance.copy()
    limit = 0.85 * variance[0] if step[11] < 0 else 2 * variance[0]
    variance += min(1.0, limit / max(np.abs(step[11:]).max(), 1e-12)) * step[11:]
    variance[0] = max(variance[0], LEAST_VARIANCE)
    strength = math.hypot(variance[1], variance[2])
    if strength > variance[0] - LEAST_VARIANCE:
        variance[1:] *= (variance[0] - LEAST_VARIANCE) / strength
    step[11:] = variance - before


@njit(error_model="numpy")
def _first_levels(image, ellipse, variance, reach, hole, planes, noise):
    """Levels inside and outside, medians over the sectors like a rim; False if there is no dark ring on bright ground."""
    sectors = geometry(ellipse, variance, reach, hole)
    totals = np.zeros((SECTORS, 4))
    determinant = ellipse[2] * ellipse[4] - ellipse[3] ** 2
    ia, ib, ic = ellipse[4] / determinant, -ellipse[3] / determinant, ellipse[2] / determinant
    left, right, top, bottom = _window(ellipse, 1 + OUTERMOST, image.shape)
    for v in range(top, bottom):
        y = v - ellipse[1]
        for u in range(left, right):
            x = u - ellipse[0]
            p, q = ia * x + ib * y, ib * x + ic * y
            away = math.sqrt(p * p + q * q)
            if away < hole or away > 1 + OUTERMOST:
                continue
            j = int(sector(p, q))
            distance = (away - 1) * away / math.hypot(ia * p + ib * q, ib * p + ic * q)
            if -sectors[j, INNER] < distance < -0.35 * sectors[j, INNER]:
                totals[j, 0] += 1
                totals[j, 1] += image[v, u]
            elif 0.35 * sectors[j, OUTER] < distance < sectors[j, OUTER]:
                totals[j, 2] += 1
                totals[j, 3] += image[v, u]
    seen = np.minimum(totals[:, 0], totals[:, 2]) > 0
    if seen.sum() < LEAST_SECTORS:
        return False
    dark, bright = totals[:, 1] / np.maximum(totals[:, 0], 1), totals[:, 3] / np.maximum(totals[:, 2], 1)
    like_rims = steep(dark, bright, seen)
    if like_rims.sum() < LEAST_SECTORS:
        return False
    planes[0], planes[3] = np.median(dark[like_rims]), np.median(bright[like_rims])
    noise[:] = max((0.1 * (planes[3] - planes[0])) ** 2, ROUNDING)
    return planes[3] > planes[0]


@njit(error_model="numpy")
def _middle(image, ellipse, hole):
    """Mean of the white middle, of its inner half."""
    determinant = ellipse[2] * ellipse[4] - ellipse[3] ** 2
    ia, ib, ic = ellipse[4] / determinant, -ellipse[3] / determinant, ellipse[2] / determinant
    size = 0.5 * hole
    left, right, top, bottom = _window(ellipse, size, image.shape)
    count, total = 0, 0.0
    for v in range(top, bottom):
        for u in range(left, right):
            x, y = u - ellipse[0], v - ellipse[1]
            if (ia * x + ib * y) ** 2 + (ib * x + ic * y) ** 2 <= size * size:
                count += 1
                total += image[v, u]
    return total / count if count else np.nan
