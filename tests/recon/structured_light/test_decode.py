"""From images to projector coordinates: round trips, predicted noise, and refusals of bad captures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.model.patterns import CentreLine, Fringes, Patterns
from recon.structured_light import plausibility
from recon.structured_light.decode import Status, decode
from recon.structured_light.phase import Noise, wrapped_phase
from tests.recon.fringe_scenes import NOISE, breast, photograph

ROOT = Path(__file__).resolve().parents[3]
SEQUENCES = ["paper_surface", "paper_calibration", "gray_surface", "multi_frequency", "twelve_step_gray"]
SHAPE = (200, 260)


def load(name: str) -> Patterns:
    return Patterns(**yaml.safe_load((ROOT / f"conf/patterns/{name}.yaml").read_text(encoding="utf-8")))


def smooth_maps(patterns, rng, shape=SHAPE):
    """Arbitrary smooth maps of both axes, well inside the projector's image, across its middle."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    maps = {}
    for axis, along, across in (("columns", u, v), ("rows", v, u)):
        length = patterns.length(axis)
        x = rng.uniform(0.4, 0.8) * (along - along.mean()) + rng.uniform(-0.2, 0.2) * (across - across.mean())
        x += rng.uniform(0, 3) * np.sin(along / rng.uniform(20, 60) + across / rng.uniform(30, 90))
        maps[axis] = (length - 1) / 2 + x
    return maps


@pytest.mark.parametrize("name", SEQUENCES)
@settings(max_examples=3, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31))
def test_round_trip(name, seed):
    """Pattern -> camera -> decode gives back the map to the predicted noise, for arbitrary smooth maps and each sequence."""
    rng, patterns = np.random.default_rng(seed), load(name)
    maps = smooth_maps(patterns, rng)
    blur = 4.0 if name == "paper_calibration" else 0.6  # binary fringes are made to be defocused
    found = decode(photograph(patterns, maps, rng, light=rng.uniform(60, 200), blur=blur), patterns)
    ok = found.status == Status.OK
    # Without the complementary bit the period borders that meet the image's frame are lost.
    assert ok.mean() > (0.92 if name == "paper_calibration" else 0.95)
    for axis, value, sigma in (("columns", found.columns, found.sigma_columns), ("rows", found.rows, found.sigma_rows)):
        if axis not in patterns.axes:
            assert value is None and sigma is None
            continue
        assert value is not None and sigma is not None
        z = ((value - maps[axis]) / sigma)[ok]
        assert np.abs(z).max() < 6  # 50 000 normal values stay below 5; rounding and the curvature within a pixel add a little
        assert z.std() < 1.2
        assert np.isnan(value[~np.isfinite(sigma)]).all()


def test_predicted_coordinate_noise_is_the_noise(rng):
    """Column errors, divided by their predicted sigma, are standard normal, with the noise measured from the capture."""
    patterns = load("paper_surface")
    x = breast((512, 640))
    found = decode(photograph(patterns, {"columns": x}, rng, light=150), patterns)
    ok = found.status == Status.OK
    assert found.columns is not None and found.sigma_columns is not None
    z = (found.columns - x)[ok] / found.sigma_columns[ok]
    # 5 standard errors, and 2.5 % for the measured noise (5 % in variance).
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) + 0.025
    assert found.noise.gain == pytest.approx(NOISE.gain, rel=0.1)
    assert found.noise_source == "measured"


@pytest.mark.parametrize("blur", [2.0, 2.7])
def test_a_line_is_found_where_nothing_is_dark_between_fringes(rng, blur):
    """Skin blurs fringes and line: a third to half of the modulation is left, and the line is darker than the darkest fringe."""
    patterns = load("paper_surface")
    maps = smooth_maps(patterns, rng)
    images = photograph(patterns, maps, rng, light=150, blur=blur)
    found = decode(images, patterns)
    assert (found.status == Status.OK).mean() > 0.95
    assert found.columns is not None
    assert np.nanmax(np.abs(found.columns - maps["columns"])) < 6  # half a period
    assert blur < 2.5 or np.percentile(images[0], 99) < np.median(images[1:].min(axis=0))


def test_a_given_noise_is_used(rng):
    patterns = load("gray_surface")
    images = photograph(patterns, smooth_maps(patterns, rng), rng)
    loud, quiet = (decode(images, patterns, noise=Noise(v, 0.0)) for v in (4.0, 1.0))
    assert quiet.noise_source == "given"
    assert quiet.sigma_columns is not None
    # but for the uncertainty of the frames' errors, which is the same in both
    assert loud.sigma_columns == pytest.approx(2 * quiet.sigma_columns, rel=1e-3, nan_ok=True)


def test_a_code_half_a_period_off_is_named(rng):
    """The middle of remainders around half a period is half a period, not none."""
    patterns = load("gray_surface")
    images = photograph(patterns, smooth_maps(patterns, rng), rng)
    code = patterns.parts[1].model_copy(update={"start": 640 - 0.5 - 64 * 12 + 6})
    refused(images, patterns.model_copy(update={"parts": (patterns.parts[0], code)}), r"lies 0\.(4[5-9]|50) period off")


def test_islands_are_no_obstacle_to_gray_code(rng):
    """Steps that break spatial unwrapping leave Gray code and heterodyne untouched."""
    u = np.mgrid[:200, :260][1].astype(float)
    x = 639.5 + 0.55 * (u - 130) + 50 * ((u // 40) % 2)
    for name in ("gray_surface", "multi_frequency"):
        patterns = load(name)
        found = decode(photograph(patterns, {"columns": x}, rng), patterns)
        ok = found.status == Status.OK
        assert ok.mean() > 0.97
        assert np.abs(found.columns - x)[ok].max() < 1


def test_status_says_why(rng):
    """Dark, saturated and outside pixels are told apart."""
    patterns = load("gray_surface")
    u = np.mgrid[:200, :260][1].astype(float)
    x = 1150 + 0.6 * u  # leaves the projector's image at the right
    light = np.where(u < 40, 2.0, np.where(u < 80, 400.0, 150.0))
    shown = np.clip(x, None, 1279.4)
    found = decode(photograph(patterns, {"columns": shown}, rng, light=light), patterns)
    assert np.mean(found.status[:, :40] == Status.DARK) > 0.99
    assert np.mean(found.status[:, 42:78] == Status.SATURATED) > 0.99
    assert np.mean(found.status[:, 82:200] == Status.OK) > 0.97
    assert found.columns is not None
    assert np.isnan(found.columns[found.status != Status.OK]).all()
    assert sum(found.summary[s.name.lower()] for s in Status) == found.status.size


def refused(images, patterns, match):
    with pytest.raises(InputError, match=match) as caught:
        decode(images, patterns, name="surface/cam1")
    assert "\n" not in str(caught.value) and str(caught.value).startswith("surface/cam1")


def test_black_saturated_and_missing_images_are_refused(rng):
    patterns = load("paper_surface")
    maps = smooth_maps(patterns, rng)
    images = photograph(patterns, maps, rng)
    refused(np.zeros_like(images), patterns, "images 1 to 8 hold no fringes")
    refused(np.full_like(images, 255), patterns, "saturated")
    refused(photograph(patterns, maps, rng, light=900.0), patterns, "saturated in .* shorten the exposure")
    refused(images[:8], patterns, "expected 9 grey images")


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("pair", [(1, 2), (3, 6), (4, 8), (5, 6), (2, 6)])
def test_swapped_fringes_are_refused(rng, pair, gamma):
    """Any two images of the sequence exchanged leave power where a sinusoid, even bent by gamma, has none."""
    patterns = load("paper_surface")
    images = photograph(patterns, smooth_maps(patterns, rng), rng, gamma=gamma)
    images[list(pair)] = images[list(pair)[::-1]]
    refused(images, patterns, f"8-step sequence, {pair[0]} and {pair[1]} look exchanged: are they in the manifest's order")


def test_a_misplaced_or_missing_line_is_refused(rng):
    patterns = load("paper_surface")
    images = photograph(patterns, smooth_maps(patterns, rng), rng)
    dark = images.copy()
    dark[0] = 8
    refused(dark, patterns, "image 0 shows no centre line")
    refused(np.roll(images, -1, axis=0), patterns, "sequence|bright over")
    repeated = images.copy()
    repeated[0] = images[3]
    refused(repeated, patterns, "image 0 is bright over")


def across(axis):
    """The Gray sequence along an axis of 1280 px, and a wall that shows most of it."""
    patterns = load("gray_surface")
    parts = tuple(part.model_copy(update={"axis": axis}) for part in patterns.parts)
    size = (1280, 800) if axis == "columns" else (800, 1280)
    x = 60 + 1160 * np.mgrid[:100, :1600][1] / 1600
    return Patterns(projector_size=size, unwrap="gray", parts=parts), {axis: x if axis == "columns" else x.T}


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_swapped_bits_are_refused(rng, axis):
    """Two Gray images exchanged: orders jump where the phase continues."""
    patterns, maps = across(axis)
    images = photograph(patterns, maps, rng)
    found = decode(images, patterns)
    value = found.columns if axis == "columns" else found.rows
    assert value is not None and np.nanmax(np.abs(value - maps[axis])) < 1
    for a, b in ((9, 10), (11, 13), (13, 14), (14, 15)):
        swapped = images.copy()
        swapped[[a, b]] = images[[b, a]]
        refused(swapped, patterns, "fringe orders jump")


def test_a_real_capture_decodes_smoothly(real):
    """A plaster relief taken by others: no order error between neighbours, columns grow along the rows, little is lost."""
    patterns = load("twelve_step_gray")
    images = np.stack([cv2.imread(str(real / "fringe_capture" / f"{i:02d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(18)])
    found = decode(images, patterns)
    steps = np.diff(found.columns, axis=1)
    steps = steps[np.isfinite(steps)]
    assert found.summary["ok"] > 200_000
    assert found.summary["uncertain"] < 100
    assert np.abs(steps).max() < 30
    assert np.mean(steps > 0) > 0.99
    for first in range(12, 17):
        swapped = images.copy()
        swapped[[first, first + 1]] = images[[first + 1, first]]
        with pytest.raises(InputError, match="fringe orders jump"):
            decode(swapped, patterns)
    for fringes in (images[11::-1], np.roll(images[:12], 1, axis=0), np.roll(images[:12], -1, axis=0)):
        with pytest.raises(InputError, match="period off the fringes"):
            decode(np.concatenate([fringes, images[12:]]), patterns)


@pytest.mark.parametrize("width", [8, 16, 32])
@pytest.mark.parametrize("name", ["gray_surface", "twelve_step_gray"])
def test_slats_are_no_swapped_bits(rng, name, width):
    """Upright slats at many depths, also at steps of whole periods: jumps everywhere, not at the borders of the code."""
    patterns = load(name)
    u = np.mgrid[:160, :640][1].astype(float)
    plane = (patterns.length("columns") - 1) / 2 + 0.55 * (u - 320)
    slat = (u // width).astype(int)
    for depth in (rng.uniform(0, 150, 100)[slat], 60.0 * (slat % 2), 130.0 * (slat % 2)):
        found = decode(photograph(patterns, {"columns": plane + depth}, rng), patterns)
        ok = found.status == Status.OK
        assert ok.mean() > 0.97
        assert found.columns is not None
        assert np.abs(found.columns - plane - depth)[ok].max() < 2


@pytest.mark.parametrize("name", ["paper_surface", "gray_surface", "twelve_step_gray"])
def test_turned_and_reversed_fringes_are_refused(rng, name):
    """Images shifted round by any number, or in reverse, are N-step sequences too: line and code tell that they are others."""
    patterns = load(name)
    images = photograph(patterns, smooth_maps(patterns, rng), rng)
    place = next(place for part, place in patterns.slices() if part.kind == "fringes")
    steps = place.stop - place.start
    for order in [np.arange(steps)[::-1], *(np.roll(np.arange(steps), k) for k in range(1, steps))]:
        wrong = images.copy()
        wrong[place] = images[place][order]
        refused(wrong, patterns, "(0.[0-9]{2} period off the fringes|fringe orders jump).*manifest's order")


@pytest.mark.parametrize(("light", "blur", "gamma"), [(30.0, 0.6, 1.0), (180.0, 3.0, 2.2), (180.0, 0.3, 0.6), (15.0, 1.5, 2.2)])
@pytest.mark.parametrize("name", ["paper_surface", "gray_surface", "twelve_step_gray"])
def test_honest_captures_pass(rng, name, light, blur, gamma):
    """Dim, blurred and bent by gamma, the right order is accepted."""
    if name == "paper_surface":
        blur = min(blur, 1.5)  # more hides a line of 2 px
    patterns = load(name)
    maps = smooth_maps(patterns, rng)
    found = decode(photograph(patterns, maps, rng, light=light, blur=blur, gamma=gamma), patterns)
    ok = found.status == Status.OK
    assert ok.mean() > 0.8
    assert np.abs(found.columns - maps["columns"])[ok].max() < 3


def test_swapped_sets_of_fringes_are_refused(rng):
    """Two pitches exchanged contradict each other in most pixels."""
    patterns = load("multi_frequency")
    images = photograph(patterns, smooth_maps(patterns, rng), rng)
    refused(images[[*range(8), *range(14, 20), *range(8, 14)]], patterns, "fringes of columns contradict each other")


@pytest.mark.parametrize("dark", [2.0, 6.0, 12.0])
def test_a_small_bright_object_is_measured_on_a_table_too_dark_to_decide(rng, dark):
    """What noise leaves open is no contradiction, and no pixel is placed at the other end of the axis. Exchanged sets are one."""
    parts = tuple(Fringes(pitch=pitch, steps=5) for pitch in (20, 140, 1200))
    patterns = Patterns(projector_size=(1200, 800), unwrap="heterodyne", parts=parts)
    columns = np.broadcast_to(20 + 1100 * np.arange(320) / 320, (240, 320))
    light = np.full(columns.shape, dark)
    light[80:160, 120:216] = 150
    images = photograph(patterns, {"columns": columns}, rng, light=light)
    found = decode(images, patterns, noise=NOISE, min_modulation_dn=0.5)
    ok = found.status == Status.OK
    assert ok[80:160, 120:216].mean() > 0.98 and np.abs(found.columns - columns)[ok].max() < 8
    with pytest.raises(InputError, match="contradict each other"):
        decode(images[[*range(5), *range(10, 15), *range(5, 10)]], patterns, noise=NOISE, min_modulation_dn=0.5)


@pytest.mark.parametrize(("light", "least"), [(14.0, 0.3), (18.0, 0.85), (30.0, 0.99)])
def test_a_wall_near_an_end_of_the_axis_is_measured(rng, light, least):
    """The other end fits the coarsest wave as well; where noise leaves that open, a pixel is unsure, and none is placed there."""
    parts = tuple(Fringes(pitch=pitch, steps=5) for pitch in (20, 140, 1200))
    patterns = Patterns(projector_size=(1200, 800), unwrap="heterodyne", parts=parts)
    columns = np.broadcast_to(1100 + 90 * np.arange(320) / 320, (160, 320))
    found = decode(photograph(patterns, {"columns": columns}, rng, light=light), patterns, noise=NOISE, min_modulation_dn=2.0)
    ok = found.status == Status.OK
    assert ok.mean() > least and np.mean(np.abs(found.columns - columns)[ok] > 8) < 2e-4


@pytest.mark.parametrize("name", ["paper_surface", "gray_surface"])
def test_sizes_that_are_no_multiple_of_the_cells(rng, name):
    patterns = load(name)
    maps = smooth_maps(patterns, rng, (403, 401))
    found = decode(photograph(patterns, maps, rng), patterns)
    ok = found.status == Status.OK
    assert found.status.shape == (403, 401)
    assert ok.mean() > 0.97
    assert np.abs(found.columns - maps["columns"])[ok].max() < 1


@pytest.mark.parametrize("size", [(5, 300), (300, 7), (1, 1)])
@pytest.mark.parametrize("name", ["paper_surface", "gray_surface"])
def test_tiny_images_are_refused(name, size):
    patterns = load(name)
    refused(np.full((patterns.count, *size), 90, np.uint8), patterns, f"8x8 px or more, found {size[1]}x{size[0]}")


@pytest.mark.parametrize("bits", [10, 12])
def test_deeper_images_decode_the_same(rng, bits):
    """The same light in digital numbers that are finer: the same columns and, but for rounding, the same noise."""
    patterns, scale = load("gray_surface"), 2 ** (bits - 8)
    maps = smooth_maps(patterns, rng)
    images = photograph(patterns, maps, rng)
    deep = images.astype(np.uint16) * scale
    coarse, fine = decode(images, patterns), decode(deep, patterns, bits=bits)
    ok = fine.status == Status.OK
    assert ok.mean() > 0.95
    assert np.abs(fine.columns - maps["columns"])[ok].max() < 1
    level = 98.0  # DN of 255, the mean of all pixels: even light doesn't tell read noise and gain apart
    variances = [n.read_variance + n.gain * level * s for n, s in ((coarse.noise, 1), (fine.noise, scale))]
    assert variances[1] == pytest.approx(variances[0] * scale**2, rel=0.05)
    assert np.nanmedian(fine.sigma_columns) == pytest.approx(np.nanmedian(coarse.sigma_columns), rel=0.05)
    assert fine.modulation[ok] == pytest.approx(coarse.modulation[ok] * scale, rel=1e-3)


def test_too_few_steps_say_that_the_noise_is_assumed(rng):
    parts = (CentreLine(), Fringes(pitch=12, steps=4))
    patterns = Patterns(projector_size=(1280, 800), unwrap="centre_line", parts=parts)
    found = decode(photograph(patterns, smooth_maps(patterns, rng), rng), patterns)
    assert found.noise_source == "assumed"


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("steps", [3, 4])
def test_a_step_taken_twice_is_refused(rng, steps, share):
    """One step shows that before it, as of a projector that lags, of fine fringes or a cue; or half of it, of the fine ones."""
    parts = (Fringes(pitch=64, steps=steps), Fringes(pitch=1280, steps=steps))
    patterns = Patterns(projector_size=(1280, 800), unwrap="heterodyne", parts=parts)
    columns = 639.5 + 1.4 * (np.mgrid[:120, :480][1] - 240.0)
    images = photograph(patterns, {"columns": columns}, rng)
    assert np.mean(decode(images, patterns).status == Status.OK) > 0.9
    for late in (1, steps - 1, *((steps + 1, 2 * steps - 1) if share == 1 else ())):
        wrong = images.copy()
        wrong[late] = np.uint8(share * images[late - 1] + (1 - share) * images[late])
        refused(wrong, patterns, "taken twice|contradict each other in .* taken once")


@pytest.mark.parametrize("steps", [3, 4, 6, 7])
@pytest.mark.parametrize("objects", [[(0.35, 0.5)], [(0.2, 0.3), (0.7, 0.8)]], ids=["one", "opposite phases"])
def test_bright_objects_on_something_dark_are_no_uneven_steps(rng, steps, objects):
    """A coarse cue as wide as the view, of albedo 0.15 and 0.8: most light is of few phases. A step taken twice still shows."""
    parts = (Fringes(pitch=16, steps=8), Fringes(pitch=114, steps=steps), Fringes(pitch=912, steps=steps))
    patterns = Patterns(projector_size=(912, 480), unwrap="heterodyne", parts=parts)
    columns = np.broadcast_to(20 + 870 * np.arange(320) / 320, (240, 320))
    light = np.full(columns.shape, 33.0)
    for left, right in objects:
        light[50:200][:, (columns[0] > left * 912) & (columns[0] < right * 912)] = 176
    images = photograph(patterns, {"columns": columns}, rng, light=light, ambient=3)
    for part, place in patterns.slices():
        fringe = wrapped_phase(images[place], part.shifts, noise=NOISE, saturation=255.0)
        plausibility.check_fringes(images[place], part, fringe, 4.0, 255.0, "images", place.start)
        twice = images[place].copy()
        twice[2] = twice[1]
        with pytest.raises(InputError, match=f"do not follow the {part.steps}-step sequence"):
            plausibility.check_fringes(twice, part, fringe, 4.0, 255.0, "images", place.start)


@pytest.mark.parametrize("least", [np.nan, -1.0, 256.0])
def test_a_least_modulation_that_is_none_is_refused(least):
    """No pixel is below one that is not a number: dark ones would all have coordinates."""
    patterns = load("paper_surface")
    images = np.zeros((patterns.count, 16, 16), np.uint8)
    with pytest.raises(InputError, match=r"^images: min_modulation_dn: expected a number from 0 to 255, found"):
        decode(images, patterns, min_modulation_dn=least)
