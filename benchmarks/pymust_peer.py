"""The peer of the B-mode model: the same array, beams and tissue in PyMUST, a simulator that follows every element.

    python -m venv VENV; VENV/bin/pip install pymust==0.1.9 pyyaml
    OMP_NUM_THREADS=1 VENV/bin/python benchmarks/pymust_peer.py

Writes `twin/experiments/pymust_peer.json`, in some minutes. PyMUST is no dependency: what reads the figures reads the file. Each
line has the 64 elements around it; Hann windows, transmit focus and receive f-number are those of `conf/ultrasound/linear.yaml`.
PyMUST gives the signals of the elements, with its own transducer and pulse; they are filtered, delayed and summed here. The
filter is a Gaussian, as wide as makes the echo's bandwidth the twin's at that depth. Points are in three dimensions; the block of
speckle is in two, for time: its lesion is a rod across the plane. Widths are full ones at half maximum of the envelope. Source:
Garcia 2022, Computer Methods and Programs in Biomedicine 218 106726 (SIMUS).
"""

import json
import sys
from pathlib import Path
from time import process_time

import numpy as np
import pymust  # pyrefly: ignore[missing-import]
import yaml
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.signal import hilbert

HERE = Path(__file__).resolve().parent
ARRAY = yaml.safe_load((HERE.parent / "conf" / "ultrasound" / "linear.yaml").read_text(encoding="utf-8"))
PITCH_MM, KERF_MM = 0.3, 0.03
SPEED = 1.54  # mm/us
DEPTHS_MM = (5.0, 15.0, 25.0, 35.0, 45.0)

BLOCK_MM = (20.0, 30.0)  # depths of the block of speckle
LESION_MM = (25.0, 3.0)  # depth and radius of a rod across the plane
LINES_MM = np.arange(-6.0, 6.01, 0.4)
BESIDE_MM = 2.5  # scatterers that a line hears
ROWS = 30  # of an element, for the lens
DENSITY = 50.0  # scatterers a mm²
LESION_DB = -12.0


def elements() -> np.ndarray:
    """Places of the elements of a line : (n,) mm, the line between the middle two."""
    count = round(ARRAY["aperture_mm"] / PITCH_MM)
    return PITCH_MM * (np.arange(count) - (count - 1) / 2)


def bandwidth(depth_mm: float) -> float:
    """Of an echo at -6 dB over the frequency, at a depth; the twin's filter narrows it with depth."""
    near, far = ARRAY["bandwidth"]
    return near + (far - near) * depth_mm / (ARRAY["scale_mm_per_px"][1] * (ARRAY["image_size"][1] - 1))


def param() -> pymust.utils.Param:
    """PyMUST's array; bandwidth (75 %) and pulse (one period) are its defaults."""
    made = pymust.utils.Param()
    made.fc, made.fs = ARRAY["frequency_mhz"] * 1e6, 4 * ARRAY["frequency_mhz"] * 1e6
    made.pitch, made.kerf, made.width = PITCH_MM * 1e-3, KERF_MM * 1e-3, (PITCH_MM - KERF_MM) * 1e-3
    made.Nelements, made.radius = len(elements()), np.inf
    made.height, made.focus = ARRAY["elevation_mm"] * 1e-3, ARRAY["elevation_focus_mm"] * 1e-3
    made.c, made.attenuation, made.baffle, made.bandwidth, made.TXnow = SPEED * 1e3, 0.0, "rigid", 75.0, 1
    return made


def filtered(signals: np.ndarray, made: pymust.utils.Param, depth_mm: float) -> np.ndarray:
    """Analytic signals : (n, elements), filtered so that an echo has the bandwidth of a depth."""
    share = np.linspace(0.3, 1.7, 20001)
    omega = 2 * np.pi * made.fc * share
    echo = np.abs(made.getPulseSpectrumFunction()(omega) * made.getProbeFunction()(omega) ** 2)

    def excess(sigma: float) -> float:
        above = share[(after := echo * np.exp(-((share - 1) ** 2) / (2 * sigma**2))) > after.max() / 2]
        return above[-1] - above[0] - bandwidth(depth_mm)

    sigma = float(np.asarray(brentq(excess, 0.05, 2.0)))
    frequencies = np.fft.fftfreq(len(signals), 1 / made.fs) / made.fc
    gain = np.exp(-((frequencies - 1) ** 2) / (2 * sigma**2))[:, None]
    return np.fft.ifft(np.fft.fft(hilbert(signals, axis=0), axis=0) * gain, axis=0)


def line(made: pymust.utils.Param, points: tuple[np.ndarray, ...], strength: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Beamformed complex signal : (m,) at depths : (m,) mm, of scatterers at x, y, z or x, z : (n,) mm from the line."""
    places, focus = elements(), ARRAY["transmit_focus_mm"]
    made.TXapodization = hann(places / (focus / ARRAY["transmit_f_number"]))[None]
    fired = (np.hypot(places.max(), focus) - np.hypot(places, focus)) / SPEED  # us
    signals, _ = pymust.simus(*(values * 1e-3 for values in points), strength, (fired * 1e-6)[None], made, options())
    analytic = filtered(signals, made, float(depths.mean()))
    times, carrier = np.arange(len(signals)) / (made.fs * 1e-6), 2 * np.pi * ARRAY["frequency_mhz"]
    outward = (np.hypot(places.max(), focus) - focus) / SPEED + depths / SPEED
    total = np.zeros(len(depths), complex)
    for k, place in enumerate(places):
        arrival = outward + np.hypot(place, depths) / SPEED
        weight = hann(place / np.minimum(depths / ARRAY["receive_f_number"], ARRAY["aperture_mm"]))
        slow = CubicSpline(times, analytic[:, k] * np.exp(-1j * carrier * times))(arrival)
        total += weight * slow * np.exp(1j * carrier * arrival)
    return total


def options() -> pymust.utils.Options:
    """An element is one piece, and frequencies below -60 dB are left out."""
    made = pymust.utils.Options()
    made.ElementSplitting, made.dBThresh = 1, -60
    return made


def hann(share: np.ndarray) -> np.ndarray:
    """Weights of places in shares of the aperture, 0 in its middle."""
    return np.where(np.abs(share) < 0.5, np.cos(np.pi * share) ** 2, 0.0)


def peak(made: pymust.utils.Param, depth: float, aside: float, across: float) -> tuple[float, np.ndarray]:
    """Greatest envelope, and envelope over 3 mm of depth, of one point. In the plane itself PyMUST would drop the lens."""
    point = tuple(np.array([value]) for value in (aside, max(across, 1e-3), depth))
    envelope = np.abs(line(made, point, np.ones(1), depth + np.linspace(-1.5, 1.5, 301)))
    return float(envelope.max()), envelope


def through_lens(depth: float, across: float) -> float:
    """Greatest envelope of a point off the plane, of one element cut into rows, which send and receive with the lens's delays.

    The four Gaussians by which the other simulation describes an element's height blur the lens's focus.
    """
    made = param()
    rows = ARRAY["elevation_mm"] * ((np.arange(ROWS) + 0.5) / ROWS - 0.5)
    made.elements, made.Nelements = np.stack([np.zeros(ROWS), rows * 1e-3]), ROWS
    made.height, made.fs = ARRAY["elevation_mm"] / ROWS * 1e-3, 8 * made.fc
    lens = (np.hypot(rows[-1], ARRAY["elevation_focus_mm"]) - np.hypot(rows, ARRAY["elevation_focus_mm"])) / SPEED  # us
    point = (np.zeros(1), np.array([across * 1e-3]), np.array([depth * 1e-3]), np.ones(1))
    signals, _ = pymust.simus3(*point, (lens * 1e-6)[None], made, pymust.utils.Options())
    analytic = filtered(signals, made, depth)
    frequencies = np.fft.fftfreq(len(signals), 1 / made.fs * 1e6)  # MHz
    delayed = np.fft.fft(analytic, axis=0) * np.exp(-2j * np.pi * np.outer(frequencies, lens))
    return float(np.abs(np.fft.ifft(delayed.sum(axis=1))).max())


def width(places: np.ndarray, values: np.ndarray) -> float:
    """Full width at half maximum of a profile with one peak."""
    fine = np.linspace(places[0], places[-1], 20001)
    curve = CubicSpline(places, values)(fine)
    top = int(curve.argmax())
    half = curve < curve[top] / 2
    return float(fine[top + half[top:].argmax()] - fine[top - half[top::-1].argmax()])


def point_target(depth: float) -> dict[str, float]:
    """Widths in depth, along the array and across the plane; the two sides of the beam are the same."""
    made = param()
    beside = np.arange(0, 1.61, 0.1)
    across = np.arange(0, 3.21, 0.1)
    along = np.array([peak(made, depth, x, 0.0)[0] for x in beside])
    over = np.array([through_lens(depth, y) for y in across])
    return {
        "depth_mm": depth,
        "axial_mm": width(np.linspace(-1.5, 1.5, 301), peak(made, depth, 0.0, 0.0)[1]),
        "lateral_mm": width(*mirrored(beside, along)),
        "elevational_mm": width(*mirrored(across, over)),
    }


def mirrored(places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A profile of one side, with the other."""
    return np.r_[-places[:0:-1], places], np.r_[values[:0:-1], values]


def block(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Beamformed speckle : (lines, depths) of the lesion's scatterers, and of those around it."""
    rng = np.random.default_rng(seed)
    low = np.array([LINES_MM[0] - BESIDE_MM, BLOCK_MM[0] - 1])
    high = np.array([LINES_MM[-1] + BESIDE_MM, BLOCK_MM[1] + 1])
    x, z = rng.uniform(low, high, (int(DENSITY * np.prod(high - low)), 2)).T
    inside = np.hypot(x, z - LESION_MM[0]) < LESION_MM[1]
    made, depths = param(), np.arange(*BLOCK_MM, 0.05)
    parts = np.zeros((2, len(LINES_MM), len(depths)), complex)
    for k, place in enumerate(LINES_MM):
        for part, members in enumerate((inside, ~inside)):
            heard = members & (np.abs(x - place) < BESIDE_MM)
            if heard.any():
                parts[part, k] = line(made, (x[heard] - place, z[heard]), np.ones(heard.sum()), depths)
        print(f"line {k + 1} of {len(LINES_MM)}", file=sys.stderr)
    return parts[0], parts[1]


def lesions(inner: np.ndarray, outer: np.ndarray) -> dict[str, float]:
    """Speckle's mean over standard deviation, and the power in the lesion's inner part over that of the same place without it."""
    depths = np.arange(*BLOCK_MM, 0.05)
    well = np.hypot(LINES_MM[:, None], depths - LESION_MM[0]) < 0.7 * LESION_MM[1]
    even = inner + outer
    gain = np.polyval(np.polyfit(depths, np.sqrt((np.abs(even) ** 2).mean(axis=0)), 2), depths)
    envelope = np.abs(even) / gain
    found = {"speckle_snr": float(envelope.mean() / envelope.std())}
    for name, share in (("lesion_db", 10 ** (LESION_DB / 20)), ("void_db", 0.0)):
        power = np.abs(share * inner + outer)[well] ** 2
        found[name] = float(10 * np.log10(power.mean() / (np.abs(even[well]) ** 2).mean()))
    return found


def plane_wave(count: int = 500) -> dict[str, float]:
    """Seconds of one core for one plane wave of 128 elements, on scatterers all over the slice; they grow with their number.

    It is the cheapest frame there is: a focused line takes half as long, and there are 321 of them.
    """
    rng = np.random.default_rng(1)
    made = param()
    made.Nelements = 128
    x, y, z = rng.uniform([-19.7, -2.0, 1.0], [19.7, 2.0, 50.0], (count, 3)).T * 1e-3
    start = process_time()
    pymust.simus(x, y, z, np.ones(count), np.zeros((1, 128)), made, options())
    return {"scatterers": count, "seconds": process_time() - start}


def main() -> None:
    widths = [point_target(depth) for depth in DEPTHS_MM]
    for row in widths:
        print(row, file=sys.stderr)
    record: dict[str, object] = {
        "command": "OMP_NUM_THREADS=1 python benchmarks/pymust_peer.py",
        "widths": widths,
        "plane_wave": plane_wave(),
    }
    parts = [lesions(*block(seed)) for seed in (1, 2)]
    block_of = {"depth_mm": LESION_MM[0], "radius_mm": LESION_MM[1], "lesion_echo_db": LESION_DB}
    for name in parts[0]:
        block_of[name] = float(np.mean([part[name] for part in parts]))
    record["block"] = block_of
    (HERE.parent / "twin" / "experiments" / "pymust_peer.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
