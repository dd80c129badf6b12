"""Sound on its way to and from a whole aperture, where tissues differ along it: wide shadows, lost focus, the array's ends.

An echo from a place reaches each element of the aperture on a way of its own. Rays are followed straight from the face, in some
directions that the aperture of a place takes in; for each place, over those that start on the array,

    amplitude = sqrt(A_t A_r) (B_t B_r)^(1/4),   A = sum(w a) / sum_all(w),   B = sum(w a^2) / sum_all(w),
    delay = sum(v D) / sum(v),   focus = exp(-2 k^2 var(D - tilt)),   v = (w_t + w_r) a,

with the weights w of the aperture that sends and of that which receives, a ray's amplitude a one way, and its delay D over that
of a medium of the assumed speed, both ways. A is the field in the beam's middle. A partly shaded aperture's beam is wider, by
about B/A², so that the power of speckle is (A_t A_r)² times the mean of both; echoes of even faces take the same. What a
disturbed wave front loses in its focus it sends beside it. A delay that rises along the apertures shifts the beam, as refraction
does; what is left spoils the focus (Strehl's ratio, by Marechal's approximation). What shades and bends stands halfway between
face and place, by assumption, where it matters whether it meets all of a line's beam alike, as it does close to the face, or
each place by itself.
Source: Born & Wolf, Principles of Optics, 9.1; Nock, Trahey & Smith 1989 for phase aberration by tissue.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from recon.compiled import kernel, njit
from recon.threads import in_threads
from twin.ultrasound.beam import Beam, beam, receive_aperture, sent_aperture
from twin.ultrasound.echo_solids import Body, between, is_sheet
from twin.ultrasound.scan_lines import lines_of, world_from_face, world_from_lines
from twin.ultrasound.sound_paths import Paths, low_frequencies, normal_at, reflection, squareness, without_contact
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

NOTHING = -50.0  # nepers, of a ray that begins in air
ECHO_MM = 3.0  # of depth that the echo of a slanted border takes within a beam; assumed
FAINT = 1e-4  # amplitude of rays, one way, whose delays count as little as those of fainter ones
STRIDE = 4  # levels from one average to the next: between them, it hardly changes


def over_aperture(paths: Paths, body: Body, transducer: Transducer, world_from_image: Array) -> Paths:
    """The paths of a pose averaged over the apertures; as they are for a transducer of one ray.

    Sheets are thinner than a wave: they turn and reflect no ray, but lose and delay it as their tissue does.
    """
    rays, lines = transducer.aperture_rays, lines_of(transducer)
    if rays == 1:
        return paths
    count, levels = paths.labels.shape
    depths = paths.step_mm * np.arange(levels)
    places = lines.pitch_mm * np.arange(count)
    poses = world_from_lines(lines, world_from_face(transducer, world_from_image), places)
    labels = np.ascontiguousarray(paths.labels[:, ::STRIDE])
    along = np.zeros((2, rays, *labels.shape), np.float32)  # loss and delay down each ray, at every STRIDE-th level
    tissues, tangents = body.acoustics(transducer.frequency_mhz), _tangents(transducer)
    delays = paths.step_mm * (transducer.assumed_speed / tissues.speed - 1)
    spread = transducer.spectral_variance(depths)
    in_threads(_follow_rays, count, along, paths, body.packed(), tissues, delays, spread, poses, tangents, lines.pitch_mm)
    along[0, :, without_contact(paths, transducer)] = NOTHING
    means = Paths(STRIDE * paths.step_mm, labels, *(np.empty(labels.shape, np.float32) for _ in range(5)))
    weights = _weights(transducer, depths[::STRIDE])
    in_threads(_gather, count, means, along, tangents, weights, lines.pitch_mm, transducer.wavenumber, transducer.refraction)
    means = means._replace(edges=_edges(means.amplitude, means.step_mm, beam(transducer), paths.step_mm))
    if transducer.refraction:
        means = _evened(means, means.step_mm * np.arange(labels.shape[1]) * (tangents[1] - tangents[0]), lines.pitch_mm)
    out = Paths(paths.step_mm, paths.labels, *(np.empty(paths.labels.shape, np.float32) for _ in range(5)))
    in_threads(_fill, count, out, means)
    return out


def _tangents(transducer: Transducer) -> Array:
    """Slopes of the rays against the line, down to the places that they meet."""
    widest = 1 / (2 * min(transducer.receive_f_number, transducer.transmit_f_number))
    return widest * np.linspace(-1, 1, transducer.aperture_rays + 2)[1:-1]


def _weights(transducer: Transducer, depths: Array) -> Array:
    """Hann's weights : (2, rays, levels) of the rays in the apertures that send and receive."""
    half = np.stack([sent_aperture(transducer, depths), receive_aperture(transducer, depths)]) / 2
    share = np.abs(_tangents(transducer))[:, None] * depths / half[:, None]
    return np.where(share < 1, np.cos(np.pi / 2 * share) ** 2, 0)


def _mean(table: Array, half: NDArray[np.int64]) -> Array:
    """Means over so many lines to either side, a number for each level."""
    count = len(table)
    line, level = np.arange(count)[:, None], np.arange(table.shape[1])[None]
    first, end = np.maximum(line - half, 0), np.minimum(line + half + 1, count)
    sums = np.concatenate([np.zeros_like(table[:1], float), np.cumsum(table, axis=0, dtype=float)])
    return (sums[end, level] - sums[first, level]) / (end - first)


def _edges(amplitude: NDArray[np.float32], step_mm: float, spread: Beam, row_mm: float) -> NDArray[np.float32]:
    """Factor after the beam that gives shadows back half of what it blurs of their edges: losses are those of places.

    What shades starts to count ECHO_MM farther down, as it would cut its own border's echo in two.
    """
    rows = np.rint(step_mm * np.arange(amplitude.shape[1]) / row_mm).astype(int)
    lateral, above = spread.lateral[np.minimum(rows, len(spread.lateral) - 1)], round(ECHO_MM / step_mm / 2)
    share, taps = np.abs(lateral) ** 2, np.arange(lateral.shape[1]) - lateral.shape[1] // 2
    sigma = np.sqrt((share * taps**2).sum(axis=1) / share.sum(axis=1))  # lines; of a box, its half width over the root of 3
    power = maximum_filter1d(amplitude.astype(float) ** 2, 2 * above + 1, axis=1, origin=above)
    least = 1e-4 * power.max(axis=0) + 1e-30
    half = np.rint(np.sqrt(3) * sigma).astype(int)
    nepers = np.log((power + least) / (_mean(power, half) + least)) / 4
    return np.exp(_mean(_mean(nepers, half // 2), half // 2)).astype(np.float32)  # smooth, or each line would show its own


def _evened(paths: Paths, apart: Array, pitch_mm: float) -> Paths:
    """Paths whose shifts and foci are means over the gaps between rays, and whose amplitudes keep the power of bent beams.

    Rays stand `apart` : (levels,) mm, so that their tilts change from line to line by more than a whole aperture's.
    Shifts are those midway between a line and the place it sees. Where they crowd places on a line it holds more scatterers,
    but no beam carries more power for being bent.
    """
    count = len(paths.labels)
    half, along = np.minimum(np.rint(apart / pitch_mm / 2).astype(int), count // 2), pitch_mm * np.arange(count)
    bent = _mean(paths.shift_mm, half) / 2
    # Lines never cross, or one would gather the power of three
    seen, shown = np.sort(along[:, None] + bent, axis=0), np.sort(along[:, None] - bent, axis=0)
    shift = _mean(np.stack([np.interp(along, one, one - line) for one, line in zip(seen.T, shown.T, strict=True)], axis=1), half)
    thinned = np.clip(1 - np.gradient(shift, pitch_mm, axis=0), 0.05, 4.0)
    amplitude, focus = paths.amplitude * np.sqrt(thinned), _mean(paths.focus, half)
    return paths._replace(
        amplitude=amplitude.astype(np.float32), shift_mm=shift.astype(np.float32), focus=focus.astype(np.float32)
    )


@kernel
def _follow_rays(first, end, along, paths, solids, tissues, delays, spread, poses, tangents, pitch_mm):
    """Sum loss and delay down the rays that start on some lines, in all directions."""
    count, levels = paths.labels.shape
    step = paths.step_mm
    for ray in range(len(tangents)):
        tangent = tangents[ray]
        longer = np.sqrt(1 + tangent * tangent)
        for start in range(first, end):
            absorbed, passed, delay, place, here = 0.0, 0.0, 0.0, float(start), paths.labels[start, 0]
            for level in range(1, levels):
                place += tangent * step / pitch_mm
                line = int(min(max(place, 0.0), count - 1.0) + 0.5)
                there = paths.labels[line, level]
                if there != here:
                    passed += np.log(max(_passed(solids, tissues, poses[line], step * level, tangent, here, there), 1e-6))
                    here = there
                absorbed += longer * step * tissues.loss[there]
                delay += longer * delays[there]
                if level % STRIDE == 0:
                    along[0, ray, start, level // STRIDE] = passed - absorbed + low_frequencies(absorbed, spread[level])
                    along[1, ray, start, level // STRIDE] = delay


@kernel
def _passed(solids, tissues, pose, depth, tangent, here, there):
    """Share of the amplitude that passes a border, there and back, of a ray at a place of a line."""
    solid = max(here, there) - 1
    if is_sheet(solids, solid):
        return 1.0
    x, y, z = pose[0, 3] + pose[0, 1] * depth, pose[1, 3] + pose[1, 1] * depth, pose[2, 3] + pose[2, 1] * depth
    nx, ny, nz = normal_at(solids, solid, x, y, z)
    onwards = nx * pose[0, 1] + ny * pose[1, 1] + nz * pose[2, 1]
    aside = nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]
    cosine = squareness(solids, solid, (onwards + tangent * aside) / np.sqrt(1 + tangent * tangent))
    r = reflection(tissues.impedance[here], tissues.impedance[there], tissues.speed[here], tissues.speed[there], cosine)
    return max(1 - r * r, 0.0)


@njit(inline="always")
def _line_of_delays(weight, d, dd, x, xx, xd):
    """Delay where x is 0, its slope, and the variance left, of a line through delays d at x, from weighted sums."""
    mean, middle = d / weight, x / weight
    variance, covariance = xx / weight - middle * middle, xd / weight - middle * mean
    slope = covariance / variance if variance > 1e-6 else 0.0
    return mean - slope * middle, slope, max(dd / weight - mean * mean - slope * covariance, 0.0)


@kernel(fastmath=True)
def _gather(first, end, means, along, tangents, weights, pitch_mm, wavenumber, refract):
    """Average over the rays that meet each place of some lines, at every STRIDE-th level."""
    _, rays, count, _ = along.shape
    for line in range(first, end):
        means.shown_mm[line, 0], means.amplitude[line, 0], means.shift_mm[line, 0], means.focus[line, 0] = 0, 1, 0, 1
        for mark in range(1, means.labels.shape[1]):
            depth = means.step_mm * mark
            every_sent = every_heard = sent = heard = sent2 = heard2 = 0.0
            there = delay = sx = sxx = sxd = sdd = 0.0
            for ray in range(rays):
                x = -tangents[ray] * depth / pitch_mm  # lines from the place to the start of its ray
                sending, hearing = weights[0, ray, mark], weights[1, ray, mark]
                every_sent, every_heard = every_sent + sending, every_heard + hearing
                if line + x < 0 or line + x > count - 1 or sending + hearing == 0:
                    continue
                at = min(int(line + x), count - 2)
                share = line + x - at
                one_way = np.exp(between(along[0, ray, at, mark], along[0, ray, at + 1, mark], share) / 2)
                d = between(along[1, ray, at, mark], along[1, ray, at + 1, mark], share)
                sent, sent2 = sent + sending * one_way, sent2 + sending * one_way * one_way
                heard, heard2 = heard + hearing * one_way, heard2 + hearing * one_way * one_way
                weight = (sending + hearing) * max(one_way, FAINT)
                there, delay, sdd = there + weight, delay + weight * d, sdd + weight * d * d
                sx, sxx, sxd = sx + weight * x, sxx + weight * x * x, sxd + weight * x * d
            both = every_sent * every_heard
            late, tilt, left = _line_of_delays(max(there, 1e-30), delay, sdd, sx, sxx, sxd)
            means.shown_mm[line, mark] = depth + late
            means.amplitude[line, mark] = np.sqrt(sent * heard / both) * (sent2 * heard2 / both) ** 0.25
            means.shift_mm[line, mark] = tilt / pitch_mm * depth if refract else 0.0
            means.focus[line, mark] = np.exp(-2 * (wavenumber * wavenumber) * left)


@kernel
def _fill(first, end, paths, means):
    """Fill the levels between those of the averages."""
    marks = means.labels.shape[1]
    for line in range(first, end):
        for level in range(paths.labels.shape[1]):
            at = min(level // STRIDE, marks - 2)
            share = np.float32((level - STRIDE * at) / STRIDE)
            paths.shown_mm[line, level] = between(means.shown_mm[line, at], means.shown_mm[line, at + 1], share)
            share = min(share, np.float32(1.0))
            paths.amplitude[line, level] = between(means.amplitude[line, at], means.amplitude[line, at + 1], share)
            paths.shift_mm[line, level] = between(means.shift_mm[line, at], means.shift_mm[line, at + 1], share)
            paths.focus[line, level] = between(means.focus[line, at], means.focus[line, at + 1], share)
            paths.edges[line, level] = between(means.edges[line, at], means.edges[line, at + 1], share)
