"""Is the gel before the skin seen, and what it adds to the brightness behind it found?"""

import numpy as np
import pytest

from recon.segmentation import echo_power, gel

STEP_MM, TOP_MM, GREY = 0.15, 3.0, 140
SHAPE, SCANS = (240, 160), 24  # 36 mm deep, 24 mm wide
TABLE, TOP = echo_power.powers(GREY), round(TOP_MM / STEP_MM)
POSES = np.tile(np.diag([STEP_MM, STEP_MM, 1.0, 1.0]), (SCANS, 1, 1))
U_MM, V_MM = STEP_MM * np.arange(SHAPE[1]), STEP_MM * np.arange(SHAPE[0])[:, None]


def scans(gel_mm, by_gel_db, rng, fall_db_mm=0.1):
    """Speckle below gel : (w,) of a thickness, brighter by so many dB a mm of it, under a gain that is a little too small."""
    level = by_gel_db * gel_mm - fall_db_mm * V_MM
    speckle = 10 * np.log10(rng.exponential(1.0, (SCANS, *SHAPE)))
    image = np.where(gel_mm > V_MM, 0.0, GREY + 255 / 60 * (level + speckle + 1.6))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("by_gel_db", [0.0, 0.3, 0.6])
def test_what_gel_adds_is_found(by_gel_db, rng):
    """Over a nipple beside the middle. Blurred, bright tissue seems to begin up to 0.5 mm early."""
    gel_mm = 8 * np.exp(-(((U_MM - 6) / 3) ** 2) / 2)
    found = gel.brightening(lambda: iter(scans(gel_mm, by_gel_db, rng)), POSES, TABLE, TOP)
    seen = gel_mm > TOP_MM + 1.0
    bright = 10 ** (by_gel_db * gel_mm[seen] / 10)
    shown = bright * (1 - np.exp(-TABLE.max() / bright))  # mean of an exponential distribution with its end cut off
    np.testing.assert_allclose(10 * np.log10(found[:, seen] / shown), 0, atol=0.2 + 0.5 * by_gel_db)
    assert (found[:, gel_mm < TOP_MM - 0.5] == 1).all(), "gel within the ringing isn't seen"


def test_without_gel_nothing_is_brighter(rng):
    """Nor by what is dark all the way down, where the array is lifted off, or in the shadow of something at the face."""
    plain = scans(0 * U_MM, 0.0, rng)
    np.testing.assert_array_equal(gel.brightening(lambda: iter(plain), POSES, TABLE, TOP), 1)
    plain[:, :, :30] = 0
    plain[:, 20:150, 40:60] = 0
    np.testing.assert_array_equal(gel.brightening(lambda: iter(plain), POSES, TABLE, TOP), 1)


def test_scans_without_a_pose_count_nothing(rng):
    """Lifted off, they show anything."""
    gel_mm = 8 * np.exp(-(((U_MM - 6) / 3) ** 2) / 2)
    images, poses = scans(gel_mm, 0.5, rng), POSES.copy()
    images[::2], poses[::2] = scans(gel_mm, 0.0, rng)[::2], np.nan
    some = gel.brightening(lambda: iter(images[1::2]), POSES[1::2], TABLE, TOP)
    np.testing.assert_array_equal(gel.brightening(lambda: iter(images), poses, TABLE, TOP)[1::2], some)
