"""Sound on its way to and from a whole aperture, where tissues differ along it: wide shadows, lost focus, the array's ends.

An echo from a place reaches each element of the aperture on a way of its own. Rays are followed straight from the face, in some
directions that the aperture of a place takes in; for each place, over those that start on the array,

    amplitude = sum(w a) / sum_all(w),   delay = sum(w D) / sum(w),   focus = exp(-2 k^2 var(D - tilt)),

with the aperture's weights w, a ray's amplitude a both ways, and its delay D over that of a medium of the assumed speed. This is
the mean power, sent and received, and holds for speckle: what a disturbed wave front loses in its focus it sends beside it. A
delay that rises along the aperture shifts the beam, as refraction does; what is left spoils the focus (Strehl's ratio, by
Marechal's approximation).
Source: Born & Wolf, Principles of Optics, 9.1; Nock, Trahey & Smith 1989 for phase aberration by tissue.
"""

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.threads import in_threads
from twin.ultrasound.beam import receive_aperture
from twin.ultrasound.echo_solids import Body, between, is_sheet
from twin.ultrasound.scan_lines import lines_of, world_from_face, world_from_lines
from twin.ultrasound.sound_paths import Paths, normal_at, reflection, squareness, without_contact
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

NOTHING = -50.0  # nepers, of a ray that begins in air
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
    tangents = np.linspace(-1, 1, rays + 2)[1:-1] / (2 * transducer.receive_f_number)
    places = lines.pitch_mm * np.arange(count)
    poses = world_from_lines(lines, world_from_face(transducer, world_from_image), places)
    along = np.zeros((2, rays, count, levels), np.float32)  # loss and delay down each ray
    tissues = body.acoustics(transducer.frequency_mhz)
    delays = paths.step_mm * (transducer.assumed_speed / tissues.speed - 1)
    in_threads(_follow_rays, count, along, paths, body.packed(), tissues, delays, poses, tangents, lines.pitch_mm)
    along[0, :, without_contact(paths, transducer)] = NOTHING
    half = receive_aperture(transducer, depths) / 2
    out = Paths(paths.step_mm, paths.labels, *(np.empty((count, levels), np.float32) for _ in range(4)))
    in_threads(_gather, count, out, along, tangents, half, lines.pitch_mm, transducer.wavenumber, transducer.refraction)
    return _evened(out, depths * (tangents[1] - tangents[0]) / lines.pitch_mm, lines.pitch_mm) if transducer.refraction else out


def _evened(paths: Paths, apart: Array, pitch_mm: float) -> Paths:
    """Paths whose shifts and foci are means over the gaps between rays, and whose amplitudes keep the power of bent beams.

    Rays stand so many lines `apart` : (levels,), so that their tilts change from line to line by more than a whole aperture's.
    Where shifts crowd places on a line it holds more scatterers, but no beam carries more power for being bent.
    """
    count = len(paths.labels)
    half = np.minimum(np.rint(apart / 2).astype(int), count // 2)
    line, level = np.arange(count)[:, None], np.arange(len(apart))[None]
    first, end = np.maximum(line - half, 0), np.minimum(line + half + 1, count)

    def mean(table: Array) -> Array:
        sums = np.concatenate([np.zeros_like(table[:1], float), np.cumsum(table, axis=0, dtype=float)])
        return (sums[end, level] - sums[first, level]) / (end - first)

    focus = mean(paths.focus)
    seen = np.sort(pitch_mm * line - mean(paths.shift_mm), axis=0)  # lines never cross, or one would gather the power of three
    shift = mean(pitch_mm * line - seen)
    thinned = np.clip(1 - np.gradient(shift, pitch_mm, axis=0), 0.05, 4.0)
    amplitude = paths.amplitude * np.sqrt(thinned)
    return Paths(paths.step_mm, paths.labels, paths.shown_mm, *(part.astype(np.float32) for part in (amplitude, shift, focus)))


@kernel
def _follow_rays(first, end, along, paths, solids, tissues, delays, poses, tangents, pitch_mm):
    """Sum loss and delay down the rays that start on some lines, in all directions."""
    count, levels = paths.labels.shape
    step = paths.step_mm
    for ray in range(len(tangents)):
        tangent = tangents[ray]
        longer = np.sqrt(1 + tangent * tangent)
        for start in range(first, end):
            loss, delay, place, here = 0.0, 0.0, float(start), paths.labels[start, 0]
            for level in range(1, levels):
                place += tangent * step / pitch_mm
                line = int(min(max(place, 0.0), count - 1.0) + 0.5)
                there = paths.labels[line, level]
                if there != here:
                    loss += np.log(max(_passed(solids, tissues, poses[line], step * level, tangent, here, there), 1e-6))
                    here = there
                loss -= longer * step * tissues.loss[there]
                delay += longer * delays[there]
                along[0, ray, start, level], along[1, ray, start, level] = loss, delay


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


@kernel(fastmath=True)
def _gather(first, end, out, along, tangents, half, pitch_mm, wavenumber, refract):
    """Average over the rays that meet each place of some lines."""
    _, rays, count, levels = along.shape
    step = out.step_mm
    for line in range(first, end):
        out.shown_mm[line, 0], out.amplitude[line, 0], out.shift_mm[line, 0], out.focus[line, 0] = 0, 1, 0, 1
        reach = 0.0  # lines from the start of a ray of tangent 1 to the place below it
        before = 0
        for level in range(1, levels):
            reach += step / pitch_mm
            if level % STRIDE != 0 and level != levels - 1:
                continue
            everything = there = power = delay = 0.0
            sx = sxx = sxd = sdd = 0.0
            for ray in range(rays):
                start = line - tangents[ray] * reach
                aside = (start - line) * pitch_mm / half[level]
                if abs(aside) >= 1:
                    continue
                weight = np.cos(np.pi / 2 * aside) ** 2
                everything += weight
                if start < 0 or start > count - 1:
                    continue
                at = min(int(start), count - 2)
                share = start - at
                loss = between(along[0, ray, at, level], along[0, ray, at + 1, level], share)
                d = between(along[1, ray, at, level], along[1, ray, at + 1, level], share)
                there += weight
                power += weight * np.exp(loss)
                x = start - line
                delay, sdd = delay + weight * d, sdd + weight * d * d
                sx, sxx, sxd = sx + weight * x, sxx + weight * x * x, sxd + weight * x * d
            if there == 0:
                there = 1.0
            mean, x0 = delay / there, sx / there
            spread, cross = sxx / there - x0 * x0, sxd / there - x0 * mean
            tilt = cross / spread if spread > 1e-6 else 0.0  # mm a line of the face
            left = max(sdd / there - mean * mean - tilt * cross, 0.0)
            out.shown_mm[line, level] = step * level + mean - tilt * x0
            out.amplitude[line, level] = power / everything
            out.shift_mm[line, level] = tilt / pitch_mm * step * level if refract else 0.0
            out.focus[line, level] = np.exp(-2 * (wavenumber * wavenumber) * left)
            for k in range(before + 1, level):
                part = np.float32((k - before) / (level - before))
                for table in (out.shown_mm, out.amplitude, out.shift_mm, out.focus):
                    table[line, k] = between(table[line, before], table[line, level], part)
            before = level
