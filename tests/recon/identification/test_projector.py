"""A projector's gamma, blur, focus and contrast, and the frames' errors, are found from images as well as is said."""

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.identification import projector
from recon.identification.estimates import Estimate, Findings
from recon.identification.projector import CameraBlur, Selection
from recon.structured_light.decode import decode
from recon.structured_light.phase import Noise
from sonotwin.choices import read_patterns
from tests.recon.identification import fringe_images
from twin.conditions import Frames

CAMERA_SIGMA = 0.03  # px, of the camera's point spread


def identified(rig, rng, sequence="gray_surface", **fixed) -> tuple[Findings, dict[str, float]]:
    """What is found of a drawn projector, and the truth."""
    drawn = {"gamma": rng.uniform(1, 2.6), "contrast": float(np.exp(rng.uniform(np.log(200), np.log(3000))))} | fixed
    lens = {"f_number": rng.uniform(1.8, 4), "focus_mm": rng.uniform(450, 900), "blur_px": rng.uniform(0.3, 1.2)}
    device = rig.projector.model_copy(update=drawn | {"lens": rig.projector.lens.model_copy(update=lens)})
    frames = Frames(flicker=rng.uniform(0, 0.02), stray_dn=rng.uniform(0, 1), shift=rng.uniform(0, 0.06))
    middle, spread, blur = rng.uniform(620, 700), rng.uniform(60, 140), rng.uniform(0.35, 0.6)
    patterns, depths = read_patterns(sequence), (middle - spread / 2, middle + spread / 2)
    shown = fringe_images.photograph(device, frames, patterns, rig.cam1.sensor, depths, blur, rng)
    camera = CameraBlur(blur + CAMERA_SIGMA * rng.standard_normal(), CAMERA_SIGMA)
    devices = fringe_images.CAMERA, fringe_images.PROJECTOR
    found = projector.identify(
        shown.images, patterns, decode(shown.images, patterns), shown.points, devices, rig.projector.lens.focal_length_mm, camera,
        room=shown.room, selection=Selection(pixels=2000),
    )  # fmt: skip
    truth = {f"projector.{name}": value for name, value in drawn.items()} | {f"projector.lens.{k}": v for k, v in lens.items()}
    return found, truth | {f"conditions.frames.{name}": value for name, value in frames.model_dump().items()}


def test_gamma_and_errors_of_frames_are_found(rig, rng):
    """Each within 3.5 of its standard deviations; gamma to 0.02, however blurred its harmonics are."""
    found, truth = identified(rig, rng)
    assert found.estimates["projector.gamma"].sigma < 0.02
    for name in truth.keys() & found.estimates.keys():
        one = found.estimates[name]
        assert abs(one.value - truth[name]) < 3.5 * one.sigma, name
    assert found.estimates.keys() | found.unknown.keys() >= truth.keys()


@pytest.mark.slow
def test_intervals_of_drawn_projectors_hold_what_they_say(rig, rng):
    """Of all numbers 95 % lie within 1.96 sigma, less 3 sigma of their count; most lenses are parted into blur and focus."""
    off, lenses = [], 0
    for _ in range(5):
        found, truth = identified(rig, rng)
        off += [(one.value - truth[name]) / one.sigma for name, one in found.estimates.items() if name in truth]
        lenses += "projector.lens.focus_mm" in found.estimates
    held = np.mean(np.abs(off) < 1.96)
    assert held > 0.95 - 3 * np.sqrt(0.95 * 0.05 / len(off)) and np.std(off) > 0.5 and lenses >= 3


def test_too_few_pixels_are_refused_with_the_cause(rig, rng):
    """Clipped ends of the range, weak fringes, and coordinates that few steps know too badly; of images that are fine else."""
    patterns, blur = read_patterns("gray_surface"), CameraBlur(0.5, CAMERA_SIGMA)
    shown = fringe_images.photograph(rig.projector, Frames(), patterns, rig.cam1.sensor, (640.0, 680.0), 0.5, rng)
    found, black = decode(shown.images, patterns), int(shown.images.min())
    rough = replace(found, sigma_columns=np.full_like(found.sigma_columns, 0.5))
    spoilt = {
        "dark stripes are at 0": (np.maximum(shown.images, black + 9) - (black + 9), found),
        "bright stripes are saturated": (np.where(shown.images > 40, 255, shown.images).astype(np.uint8), found),
        "modulation is below 10 of 255": (shown.images, replace(found, modulation=found.modulation / 100)),
        "columns are known to 0.5 px in the median, not to 0.2": (shown.images, rough),
    }
    devices = fringe_images.CAMERA, fringe_images.PROJECTOR
    assert len(projector.sample(shown.images, patterns, found, shown.points, devices, blur).block) > 500
    for cause, (images, one) in spoilt.items():
        with pytest.raises(InputError, match=cause):
            projector.sample(images, patterns, one, shown.points, devices, blur)


def test_noise_may_reach_the_end_of_the_range_in_dark_stripes(rig, rng):
    """By 1.4 of 3 DN, of which 0.4 % of a DN is clipped in the mean; by 6 DN too much is, and pixels are refused."""
    patterns, blur = read_patterns("gray_surface"), CameraBlur(0.5, CAMERA_SIGMA)
    device, devices = rig.projector.model_copy(update={"contrast": 1e5}), (fringe_images.CAMERA, fringe_images.PROJECTOR)
    for noise_dn, enough in ((1.4, True), (6.0, False)):
        clipped = rng.normal(3.0, noise_dn, 1_000_000).clip(0).mean() - 3
        dim = {"black_level_dn": 0.0, "dark_noise_e": noise_dn * rig.cam1.sensor.saturation_e / 256}
        sensor = rig.cam1.sensor.model_copy(update=dim)
        shown = fringe_images.photograph(device, Frames(), patterns, sensor, (640.0, 680.0), 0.5, rng)
        found = replace(decode(shown.images, patterns), noise=Noise(noise_dn**2, 256 / sensor.saturation_e))
        selection = Selection(place_px=1.0)
        if enough:
            chosen = projector.sample(shown.images, patterns, found, shown.points, devices, blur, selection=selection)
            assert len(chosen.block) > 500 and clipped < 0.01
        else:
            assert clipped > 0.5
            with pytest.raises(InputError, match="at 0, the end of the range"):
                projector.sample(shown.images, patterns, found, shown.points, devices, blur, selection=selection)


@pytest.mark.slow
def test_three_pitches_show_the_same(rig, rng):
    """Without a code: each number within 3.5 of its standard deviations."""
    found, truth = identified(rig, rng, "multi_frequency")
    assert {"projector.gamma", "conditions.frames.flicker"} <= found.estimates.keys()
    for name in truth.keys() & found.estimates.keys():
        one = found.estimates[name]
        assert abs(one.value - truth[name]) < 3.5 * one.sigma, name


@pytest.mark.parametrize(("total", "part"), [(3.0, 0.5), (12.5, 12.4), (0.3, 0.3)])
def test_a_lens_that_is_not_measured_blurs_as_is_seen(rig, total, part):
    """Point spread and disc together, at the depth where they were seen; one that is measured stays."""
    depth = 700.0
    seen = Findings(
        {name: Estimate(value, 0.1, "a test") for name, value in zip(projector.SEEN, (total, part, depth), strict=True)}
    )
    lens, focal_px = projector.with_blur_as_seen(rig.projector, seen).lens, rig.projector.optics.focal_px[0]
    disc = focal_px * lens.aperture_mm * abs(1 / depth - 1 / lens.focus_mm)
    assert np.hypot(lens.blur_px, disc / 4) == pytest.approx(total) and lens.f_number == rig.projector.lens.f_number
    assert lens.focus_mm <= depth + 1e-9
    assert projector.with_blur_as_seen(rig.projector, Findings()) == rig.projector
