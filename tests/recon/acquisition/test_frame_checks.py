"""Faults are named of frames that have them, and of no others."""

import cv2
import numpy as np
import pytest

from recon.acquisition import frame_checks
from recon.acquisition.frame_checks import Limits
from recon.model.patterns import Fringes, GrayCode, Patterns

LIMITS = Limits()


def discs(rng, sigma_px: float = 0.8, motion_px: int = 1, level: float = 200.0, noise: float = 1.0) -> np.ndarray:
    """White paper with black discs, blurred by the lens and by a motion along u."""
    image = np.full((240, 320), level, np.float32)
    for u in range(40, 320, 60):
        for v in range(40, 240, 60):
            cv2.circle(image, (u * 16 + 5, v * 16 + 3), 16 * 16, 0.1 * level, -1, cv2.LINE_AA, 4)
    image = cv2.GaussianBlur(image, (0, 0), sigma_px)
    image = cv2.blur(image, (motion_px, 1))
    return np.clip(np.rint(image + noise * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def test_a_good_frame_has_no_faults(rng):
    found = frame_checks.look(discs(rng), 8)
    assert frame_checks.frame_faults(found, LIMITS) == [] and 0.75 < found.level < 0.82


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 4.0])
def test_the_width_of_edges_is_their_blur(rng, sigma_px):
    """Within 20 %: discs of 16 px have round rims, and the gradient is measured over three pixels."""
    assert frame_checks.look(discs(rng, sigma_px), 8).focus_px == pytest.approx(sigma_px, rel=0.2)


@pytest.mark.parametrize(
    ("change", "word", "way"),
    [
        ({"level": 400.0}, "saturated", "halve"),
        ({"level": 25.0, "noise": 0.5}, "dark", "times as long"),
        ({"sigma_px": 4.0}, "blurred", "focus the lens"),
        ({"motion_px": 13}, "blurred", "hold still"),
    ],
)
def test_a_fault_is_named_with_the_way_to_mend_it(rng, change, word, way):
    faults = frame_checks.frame_faults(frame_checks.look(discs(rng, **change), 8), LIMITS)
    assert len(faults) == 1 and faults[0].startswith(word) and way in faults[0]


def test_nothing_is_said_of_the_edges_of_what_has_none(rng):
    smooth = np.tile(np.linspace(60, 200, 320), (240, 1)) + rng.standard_normal((240, 320))
    found = frame_checks.look(np.uint8(smooth), 8)
    assert np.isnan(found.focus_px) and frame_checks.frame_faults(found, LIMITS) == []


PATTERNS = Patterns(projector_size=(320, 240), unwrap="gray", parts=(Fringes(pitch=16, steps=4), GrayCode(pitch=16, bits=5)))


@pytest.mark.parametrize(("white", "word"), [(0.6, None), (0.02, "weak fringes"), (0.0, "no fringes"), (1.3, "saturated")])
def test_fringes_are_judged(rng, white, word):
    stray = 8.0 + rng.standard_normal((PATTERNS.count, 240, 320))
    images = np.clip(np.rint(255 * white * PATTERNS.images() + stray), 0, 255).astype(np.uint8)
    faults = frame_checks.fringe_faults(frame_checks.contrast(images, PATTERNS, 8, LIMITS), LIMITS)
    assert [fault.partition(":")[0] for fault in faults] == ([word] if word else [])


def test_depth_changes_no_verdict(rng):
    image = discs(rng)
    eight, ten = frame_checks.look(image, 8), frame_checks.look(np.uint16(image) * 4, 10)
    assert ten.level == pytest.approx(eight.level, abs=0.01) and ten.focus_px == pytest.approx(eight.focus_px, rel=0.01)
