"""The peer of sound's ways through tissue: layers, a lobule, shadows, loss and speckle in k-Wave, which solves the wave equation.

    python -m venv VENV
    VENV/bin/pip install numpy scipy matplotlib beartype jaxtyping deepdiff deprecated tqdm h5py wrapt orderly-set wadler-lindig
    VENV/bin/pip install --no-deps k-wave-python==0.6.2
    OMP_NUM_THREADS=1 VENV/bin/python benchmarks/kwave_peer.py

Writes `twin/experiments/kwave_peer.json`, in some ten minutes of one core. k-Wave is no dependency: what reads the figures reads
the file, in which the media stand beside them. Simulations are in two dimensions, as the image's plane, by the solver in NumPy.

**Points.** A small scatterer sends to an element just what the element sends to it (reciprocity of pressure and volume velocity,
in any linear medium at rest). So one run, from a source at the scatterer to the cells of the face, holds the ways of all
elements there and back: the echo sent by element i and heard by element j has the spectrum G_i G_j. Of these, focused transmit
beams and the dynamic receive aperture are made for every line, with Hann windows, as `docs/physics-ultrasound.md` has them. One
filter, the same for all, makes the echo of a point at the transmit focus of an even medium a Gaussian of the bandwidth.
Simulated without that, a dense cell behind the lobule is shown 0.498 mm aside under a flat wave; by reciprocity 0.491 mm.

**Speckle.** A flat wave is sent into a medium whose density differs from cell to cell, and echoes at the face are delayed and
summed for every line, less those of the even medium. That is a simulation of scattering itself. Cells scatter as f^1.5, which the
filter takes out, with the pulse. Speckle of the focused beam is the sum over an even medium's points, each heard as above.

Widths are full ones at half maximum. Source: Treeby and Cox 2010, J. Biomed. Opt. 15(2) 021314 (k-Wave).
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from scipy.interpolate import CubicSpline


def _nothing(address: str, name: str, *_: object) -> tuple[str, None]:
    """Stands for the download of the compiled solvers, which are not used."""
    Path(name).write_bytes(b"")
    return name, None


with patch("urllib.request.urlretrieve", _nothing):  # k-Wave would fetch them on import
    from kwave.kgrid import kWaveGrid  # pyrefly: ignore[missing-import]
    from kwave.kmedium import kWaveMedium  # pyrefly: ignore[missing-import]
    from kwave.ksensor import kSensor  # pyrefly: ignore[missing-import]
    from kwave.ksource import kSource  # pyrefly: ignore[missing-import]
    from kwave.kspaceFirstOrder import kspaceFirstOrder  # pyrefly: ignore[missing-import]

RECORD = Path(__file__).resolve().parent.parent / "twin" / "experiments" / "kwave_peer.json"
SPEED = 1540.0  # m/s, assumed by the scanner and true of the even medium
DENSITY = 1041.0  # kg/m3 of the even medium
ARRAY = {"frequency_mhz": 3.0, "bandwidth": 0.5, "transmit_focus_mm": 15.0, "transmit_f_number": 3.0, "receive_f_number": 2.0}
CELL_MM = 0.1  # five to a wave at the centre frequency, three at the band's end
FACE = 5  # row of the face; the absorbing layer lies behind
PULSE_MHZ = 1.2  # standard deviation of the spectrum of what sources send
FREQUENCIES_MHZ = np.arange(1.0, 5.0, 0.0125)  # beyond them echoes have less than 1 % of the amplitude; echoes of 80 us
PULSE_START_US = 4 / (2 * np.pi * PULSE_MHZ)  # of its middle, before which it is nothing
LAST_US = 2.0  # after the latest straight way, for the pulse and what comes round

# Layers under the face: depth of the end, mm; m/s; kg/m3, of skin, fat, gland and muscle, with skin and muscle faster than most
LAYERS = ((2.05, 1580.0, 1109.0), (9.05, 1440.0, 911.0), (14.05, 1540.0, 1041.0), (60.0, 1580.0, 1090.0))
LAYER_POINTS_MM = (6.0, 12.0, 20.0)
FAT = (1440.0, 911.0)
SLANT = {"depth_mm": 6.05, "tilt_deg": 20.0}  # fat over gland: deeper to the right
BEHIND_SLANT_MM = (15.0, 20.0)  # depths of points in the middle
LOBULE = {"middle_mm": (0.0, 9.0), "half_mm": (5.0, 3.0)}  # fat in gland: an ellipse
BEHIND_LOBULE_MM = ((1.2, 16.0), (2.5, 16.0), (2.5, 20.0), (4.0, 20.0))
DISC = {"depth_mm": 8.0, "radius_mm": 2.5, "loss_db_per_cm_mhz": 12.0}
BEHIND_MM, BEHIND_STEP_MM, BEHIND_COUNT = 16.0, 0.8, 9  # depth of points behind the disc, and their places beside its middle
LOSS = 0.7  # dB/cm/MHz
ROWS_MM = (5.0, 6.0, 10.0, 12.0, 15.0, 16.0, 20.0, 25.0, 30.0, 35.0)  # depths in the even media
SPECKLE = {"seeds": (1, 2, 3, 4, 5), "near_mm": 8.0, "far_mm": 20.0, "contrast": 0.02}
SPECKLE_LINES_MM = np.arange(-13.0, 13.01, 0.2)


class Medium(NamedTuple):
    """Speed, m/s, density, kg/m3, and loss, dB/cm/MHz, of each cell : (across, down)."""

    speed: np.ndarray
    density: np.ndarray
    loss: np.ndarray


class Heard(NamedTuple):
    """Spectra : (places, frequencies) at places : (n,) mm along the array."""

    places: np.ndarray
    spectra: np.ndarray


def even(across: int, down: int) -> Medium:
    """The even medium of a number of cells."""
    return Medium(*(np.full((across, down), value) for value in (SPEED, DENSITY, 0.0)))


def along(medium: Medium) -> np.ndarray:
    """Places of the cells along the array, mm; 0 is one of them."""
    count = len(medium.speed)
    return CELL_MM * (np.arange(count) - count // 2)


def depths(medium: Medium) -> np.ndarray:
    """Depths of the cells under the face, mm."""
    return CELL_MM * (np.arange(medium.speed.shape[1]) - FACE)


def cell(middles_mm: np.ndarray, place_mm: float) -> int:
    """Number of the cell in whose middle a place is; ValueError if it is in none's."""
    nearest = int(np.abs(middles_mm - place_mm).argmin())
    if abs(middles_mm[nearest] - place_mm) > 1e-6:
        raise ValueError(f"point: expected one in the middle of a cell of {CELL_MM} mm, found {place_mm} mm")
    return nearest


def solved(medium: Medium, sent: np.ndarray, recorded: np.ndarray, longest_mm: float) -> tuple[np.ndarray, float]:
    """Pressure : (cells, times) at the recorded cells, and the time step, us.

    sent : (across, down) amplitude of the pulse that cells send
    recorded : (across, down) bool
    """
    grid = kWaveGrid(medium.speed.shape, (1e-3 * CELL_MM,) * 2)
    # Sound comes late through media slower than the fastest, by the step's square: with 0.12, by 1 % of what a layer delays it
    uneven = medium.speed.min() < medium.speed.max()
    step_us = (0.12 if uneven else 0.3) * 1e3 * CELL_MM / medium.speed.max()
    grid.setTime(int((1e3 * longest_mm / medium.speed.min() + LAST_US + PULSE_START_US) / step_us), 1e-6 * step_us)
    acoustic = kWaveMedium(sound_speed=medium.speed, density=medium.density)
    if medium.loss.any():  # linear in frequency, for which k-Wave has no dispersion
        acoustic.alpha_coeff, acoustic.alpha_power, acoustic.alpha_mode = medium.loss, 1.0, "no_dispersion"
    source = kSource()
    source.p_mask = sent != 0
    source.p = sent[sent != 0][:, None] * pulse(step_us * np.arange(int(2 * PULSE_START_US / step_us)))
    sensor = kSensor(mask=recorded, record=["p"])
    found = kspaceFirstOrder(grid, acoustic, source, sensor, backend="python", dtype="float32", quiet=True)
    return found["p"], step_us


def pulse(times_us: np.ndarray) -> np.ndarray:
    """What a source sends: a Gaussian spectrum about the centre frequency."""
    late = times_us - PULSE_START_US
    return np.exp(-((2 * np.pi * PULSE_MHZ * late) ** 2) / 2) * np.cos(2 * np.pi * ARRAY["frequency_mhz"] * late)


def spectra(signals: np.ndarray, step_us: float) -> np.ndarray:
    """Spectra over the band, of signals (..., times), with the pulse's middle at 0."""
    late = step_us * np.arange(signals.shape[-1]) - PULSE_START_US
    return step_us * signals @ np.exp(-2j * np.pi * np.outer(late, FREQUENCIES_MHZ))


def from_point(medium: Medium, aside_mm: float, depth_mm: float) -> Heard:
    """Ways of a point of the medium to the cells of the face."""
    x, y = along(medium), depths(medium)
    sent, recorded = np.zeros(medium.speed.shape), np.zeros(medium.speed.shape, bool)
    sent[cell(x, aside_mm), cell(y, depth_mm)] = 1
    recorded[:, FACE] = True
    signals, step_us = solved(medium, sent, recorded, float(np.hypot(np.abs(x - aside_mm).max(), depth_mm)))
    return Heard(x, spectra(signals, step_us))


def to_rows(medium: Medium) -> list[Heard]:
    """Ways of points at depths `ROWS_MM` of a medium that is the same all along; one run, from the face's middle."""
    x, y = along(medium), depths(medium)
    sent, recorded = np.zeros(medium.speed.shape), np.zeros(medium.speed.shape, bool)
    rows = [cell(y, depth) for depth in ROWS_MM]
    sent[len(x) // 2, FACE] = 1
    recorded[:, rows] = True
    signals, step_us = solved(medium, sent, recorded, float(np.hypot(np.abs(x).max(), ROWS_MM[-1])))
    signals = signals.reshape(len(x), len(rows), -1)
    return [Heard(x, spectra(signals[:, row], step_us)) for row in range(len(rows))]


def hann(share: np.ndarray) -> np.ndarray:
    """Weights of places in shares of the aperture, 0 in its middle."""
    return np.where(np.abs(share) < 0.5, np.cos(np.pi * share) ** 2, 0.0)


def wanted() -> np.ndarray:
    """Spectrum of an echo, of the bandwidth at -6 dB."""
    share = (FREQUENCIES_MHZ / ARRAY["frequency_mhz"] - 1) / ARRAY["bandwidth"]
    return np.exp(-4 * np.log(2) * share**2)


def parts(heard: Heard, line_mm: float, depth_mm: np.ndarray) -> np.ndarray:
    """Spectra : (depths, frequencies) of a point's echo on a line, as they add up at shown depths : (m,) mm."""
    turn = 2j * np.pi * FREQUENCIES_MHZ
    beside, focus, speed = heard.places - line_mm, ARRAY["transmit_focus_mm"], 1e-3 * SPEED
    weight = hann(beside / (focus / ARRAY["transmit_f_number"]))
    fired = (focus - np.hypot(focus, beside)) / speed
    used = weight > 0
    sent = np.einsum("i,if->f", weight[used], heard.spectra[used] * np.exp(-turn * fired[used, None]))
    out = np.empty((len(depth_mm), len(turn)), complex)
    for k, depth in enumerate(depth_mm):
        weight = hann(beside / (depth / ARRAY["receive_f_number"]))
        used = weight > 0
        back = (depth + np.hypot(depth, beside[used])) / speed
        out[k] = np.einsum("i,if->f", weight[used] / weight.sum(), heard.spectra[used] * np.exp(turn * back[:, None]))
    return sent * out


def image(heard: Heard, lines_mm: np.ndarray, depth_mm: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Complex echo : (lines, depths) of a point, filtered by the spectrum of the reference's."""
    gain = wanted() / reference
    return np.array([parts(heard, line, depth_mm) @ gain for line in lines_mm]) / wanted().sum()


def reference_echo(rows: list[Heard]) -> np.ndarray:
    """Spectrum of the echo of a point at the transmit focus of the even medium."""
    focus = ARRAY["transmit_focus_mm"]
    return parts(rows[ROWS_MM.index(focus)], 0.0, np.array([focus]))[0]


def top(places: np.ndarray, values: np.ndarray) -> float:
    """Place of the greatest value, through a cubic spline."""
    fine = np.linspace(places[0], places[-1], 20001)
    return float(fine[CubicSpline(places, values)(fine).argmax()])


def width(places: np.ndarray, values: np.ndarray) -> float:
    """Full width at half maximum of a profile with one peak."""
    fine = np.linspace(places[0], places[-1], 20001)
    curve = CubicSpline(places, values)(fine)
    peak = int(curve.argmax())
    half = curve < curve[peak] / 2
    return float(fine[peak + half[peak:].argmax()] - fine[peak - half[peak::-1].argmax()])


def layered() -> Medium:
    """`LAYERS` under the face."""
    medium = even(240, 240)
    for end, speed, density in LAYERS[::-1]:
        medium.speed[:, depths(medium) < end], medium.density[:, depths(medium) < end] = speed, density
    return medium


def slanted() -> Medium:
    """Fat over gland, with a slanted border."""
    medium = even(240, 240)
    fat = depths(medium) < SLANT["depth_mm"] + np.tan(np.deg2rad(SLANT["tilt_deg"])) * along(medium)[:, None]
    medium.speed[fat], medium.density[fat] = FAT
    return medium


def with_lobule() -> Medium:
    """A fat ellipse in gland."""
    medium = even(240, 240)
    (x, y), (a, b) = LOBULE["middle_mm"], LOBULE["half_mm"]
    fat = np.hypot((along(medium)[:, None] - x) / a, (depths(medium) - y) / b) < 1
    medium.speed[fat], medium.density[fat] = FAT
    return medium


def with_disc() -> Medium:
    """A disc that absorbs, and differs in nothing else."""
    medium = even(240, 240)
    disc = np.hypot(along(medium)[:, None], depths(medium) - DISC["depth_mm"]) < DISC["radius_mm"]
    medium.loss[disc] = DISC["loss_db_per_cm_mhz"]
    return medium


def shown(heard: Heard, aside_mm: float, depth_mm: float, reference: np.ndarray) -> tuple[float, float]:
    """Where a point is shown, mm: along the array and deep, by the greatest envelope."""
    lines, rows = aside_mm + np.arange(-2.5, 2.51, 0.1), depth_mm + np.arange(-1.5, 1.51, 0.04)
    envelope = np.abs(image(heard, lines, rows, reference))
    aside = top(lines, envelope.max(axis=1))
    column = np.abs(image(heard, np.array([aside]), rows, reference))[0]
    return aside, top(rows, column)


def delays(rows: list[Heard], reference: np.ndarray) -> list[dict[str, float]]:
    """Points under layers: how much deeper they are shown than in the even medium, on the line above them."""
    medium, found = layered(), []
    for depth in LAYER_POINTS_MM:
        near = depth + np.arange(-1.5, 1.51, 0.04)
        columns = [
            image(heard, np.zeros(1), near, reference)[0]
            for heard in (from_point(medium, 0.0, depth), rows[ROWS_MM.index(depth)])
        ]
        late, true = (top(near, np.abs(column)) for column in columns)
        found.append({"depth_mm": depth, "late_mm": late - true})
    return found


def shifts(medium: Medium, points: Sequence[tuple[float, float]], reference: np.ndarray) -> list[dict[str, float]]:
    """Points behind a border that bends sound: how far aside they are shown."""
    found = []
    for aside, depth in points:
        x, y = shown(from_point(medium, aside, depth), aside, depth, reference)
        found.append({"aside_mm": aside, "depth_mm": depth, "shift_mm": x - aside, "late_mm": y - depth})
    return found


def shadow(rows: list[Heard], reference: np.ndarray) -> dict[str, object]:
    """Amplitude behind the disc over that without it, by place along the array; widths at half of it, and of the shadow's edge.

    Of points by their greatest envelope, and of speckle by the power on a line, summed over all points. The edge goes from a
    quarter to three quarters.
    """
    places = BEHIND_STEP_MM * np.arange(BEHIND_COUNT)
    lines = np.arange(-places[-1], places[-1] + 0.01, BEHIND_STEP_MM / 4)
    near = BEHIND_MM + np.arange(-1.2, 1.21, 0.08)
    clear, dark, medium = rows[ROWS_MM.index(BEHIND_MM)], [], with_disc()
    powers, peaks = np.zeros((2, len(lines))), np.zeros((2, len(places)))
    for k, place in enumerate(places):
        dark.append(from_point(medium, float(place), BEHIND_MM))
        for case, envelope in enumerate(
            np.abs(image(heard, lines - moved, near, reference)) for heard, moved in ((dark[-1], 0.0), (clear, place))
        ):
            energy = (envelope**2).sum(axis=1)
            powers[case] += energy + (energy[::-1] if place else 0)
            peaks[case, k] = envelope.max()
    speckle, points = np.sqrt(powers[0] / powers[1]), peaks[0] / peaks[1]
    middle = len(lines) // 2
    quarters = np.interp([0.25, 0.75], speckle[middle:], lines[middle:])
    return {
        "points_mm": places.tolist(),
        "lines_mm": lines[middle:].tolist(),
        "speckle": speckle[middle:].tolist(),
        "points": points.tolist(),
        "speckle_width_mm": 2 * float(np.interp(0.5, speckle[middle:], lines[middle:])),
        "speckle_edge_mm": float(np.diff(quarters)[0]),
        "points_width_mm": 2 * float(np.interp(0.5, points, places)),
    }


def losses(rows: list[Heard], reference: np.ndarray) -> list[dict[str, float]]:
    """Loss of a point's echo, dB, by its depth: of the greatest envelope, and the frequency in the middle of its spectrum."""
    medium = even(240, 380)
    medium.loss[:] = LOSS
    found = []
    for depth, clear, lossy in zip(ROWS_MM, rows, to_rows(medium), strict=True):
        near = depth + np.arange(-1.5, 1.51, 0.04)
        peaks = [np.abs(image(heard, np.zeros(1), near, reference)).max() for heard in (clear, lossy)]
        spectrum = np.abs(parts(lossy, 0.0, np.array([depth]))[0] * wanted() / reference)
        middle = float((FREQUENCIES_MHZ * spectrum).sum() / spectrum.sum())
        found.append({"depth_mm": depth, "loss_db": float(20 * np.log10(peaks[0] / peaks[1])), "frequency_mhz": middle})
    return found


def autocorrelation(fields: np.ndarray, step_mm: float, axis: int) -> float:
    """Full width at half maximum, mm, of the complex autocorrelation's magnitude along an axis of fields : (n, lines, depths)."""
    fields = np.moveaxis(fields, axis, -1)
    count, lags = fields.shape[-1], round(4.0 / step_mm)
    shared = np.array(
        [np.vdot(fields[..., : count - lag], fields[..., lag:]) / (count - lag) for lag in range(min(lags, count - 1))]
    )
    places = step_mm * np.arange(len(shared))
    return width(np.r_[-places[:0:-1], places], np.r_[np.abs(shared[:0:-1]), np.abs(shared)])


def speckle_of_points(rows: list[Heard], depth: float, reference: np.ndarray) -> dict[str, float]:
    """Speckle of the focused beam about a depth, of scatterers at all places: it is alike as a point's image is with itself."""
    lines, near = np.arange(-6.0, 6.01, 0.1), depth + np.arange(-2.0, 2.01, 0.04)
    field = image(rows[ROWS_MM.index(depth)], lines, near, reference)[None]
    return {"depth_mm": depth, "lateral_mm": autocorrelation(field, 0.1, 1), "axial_mm": autocorrelation(field, 0.04, 2)}


def speckle_of_a_flat_wave() -> dict[str, object]:
    """Speckle of cells of uneven density under a flat wave, received on all lines; the mean of some media."""
    shape, x = (400, 240), along(even(400, 240))
    sent, recorded = np.zeros(shape), np.zeros(shape, bool)
    edge = np.minimum((x - x[0] + CELL_MM) / 4.0, (x[-1] - x + CELL_MM) / 4.0)
    sent[:, FACE] = np.sin(np.pi / 2 * np.minimum(edge, 1.0)) ** 2
    recorded[:, FACE] = True
    near = np.arange(SPECKLE["near_mm"], SPECKLE["far_mm"], 0.05)
    signals = []
    for seed in (None, *SPECKLE["seeds"]):
        medium = even(*shape)
        if seed is not None:
            uneven = SPECKLE["contrast"] * np.random.default_rng(seed).standard_normal(shape)
            medium.density[:] *= 1 + uneven * (depths(medium) > 4.0)
        found, step_us = solved(medium, sent, recorded, 2.2 * SPECKLE["far_mm"])
        signals.append(spectra(found, step_us))
        print(f"speckle {seed}", file=sys.stderr)
    sent_spectrum = np.exp(-((FREQUENCIES_MHZ - ARRAY["frequency_mhz"]) ** 2) / (2 * PULSE_MHZ**2))
    gain = wanted() / (sent_spectrum * FREQUENCIES_MHZ**1.5)
    fields = np.array([received(x, (one - signals[0]) * gain, near) for one in signals[1:]])
    fields /= np.sqrt((np.abs(fields) ** 2).mean(axis=(0, 1)))
    return {
        "near_mm": SPECKLE["near_mm"],
        "far_mm": SPECKLE["far_mm"],
        "lateral_mm": autocorrelation(fields, 0.2, 1),
        "axial_mm": autocorrelation(fields, 0.05, 2),
        "lateral_each_mm": [autocorrelation(one[None], 0.2, 1) for one in fields],
        "snr": float(np.abs(fields).mean() / np.abs(fields).std()),
    }


def received(places: np.ndarray, heard: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Echoes of a flat wave : (lines, depths), delayed and summed over the dynamic receive aperture, from spectra at the face."""
    times, carrier = np.arange(0.0, 40.0, 0.05), 2 * np.pi * ARRAY["frequency_mhz"]
    slow = heard @ np.exp(2j * np.pi * np.outer(FREQUENCIES_MHZ - ARRAY["frequency_mhz"], times))
    curves, speed = [CubicSpline(times, one) for one in slow], 1e-3 * SPEED
    out = np.zeros((len(SPECKLE_LINES_MM), len(depth_mm)), complex)
    for k, line in enumerate(SPECKLE_LINES_MM):
        for place, curve in zip(places - line, curves, strict=True):
            weight = hann(place / (depth_mm / ARRAY["receive_f_number"])) / depth_mm
            if (used := weight > 0).any():
                arrival = (depth_mm[used] + np.hypot(depth_mm[used], place)) / speed
                out[k, used] += weight[used] * curve(arrival) * np.exp(1j * carrier * arrival)
    return out


def main() -> None:
    start = process_time()

    def done(what: str) -> None:
        print(f"{process_time() - start:6.0f} s  {what}", file=sys.stderr, flush=True)

    rows = to_rows(even(240, 380))
    reference = reference_echo(rows)
    done("even medium")
    record: dict[str, object] = {
        "command": "OMP_NUM_THREADS=1 python benchmarks/kwave_peer.py",
        "array": ARRAY,
        "speed": SPEED,
        "density": DENSITY,
        "layers": LAYERS,
        "fat": FAT,
        "slant": SLANT,
        "lobule": LOBULE,
        "disc": DISC,
        "loss_db_per_cm_mhz": LOSS,
        "delays": delays(rows, reference),
    }
    done("layers")
    record["shifts_slant"] = shifts(slanted(), [(0.0, depth) for depth in BEHIND_SLANT_MM], reference)
    done("slanted border")
    record["shifts_lobule"] = shifts(with_lobule(), BEHIND_LOBULE_MM, reference)
    done("lobule")
    record["shadow"] = {"depth_mm": BEHIND_MM} | shadow(rows, reference)
    done("disc")
    record["losses"] = losses(rows, reference)
    done("loss")
    record["speckle_focused"] = [speckle_of_points(rows, depth, reference) for depth in (10.0, 15.0, 20.0)]
    record["speckle_flat"] = speckle_of_a_flat_wave()
    done("speckle")
    RECORD.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
