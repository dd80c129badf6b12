"""Is the gel before the skin seen, and what it adds to the brightness behind it found?"""

import numpy as np
import pytest

from recon.errors import InputError
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


NIPPLE = 8 * np.exp(-(((U_MM - 6) / 3) ** 2) / 2)  # mm of gel beside it
SEEN = NIPPLE > TOP_MM + 2


def factors(images):
    return gel.brightening(lambda: iter(images), POSES, TABLE, TOP)


def decibels(by_gel_db):
    """That tissue behind gel is brighter by, as shown: the mean of an exponential distribution with its end cut off."""
    bright = 10 ** (by_gel_db * NIPPLE[SEEN] / 10)
    return 10 * np.log10(bright * (1 - np.exp(-TABLE.max() / bright)))


@pytest.mark.parametrize("by_gel_db", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("black", [False, True])
def test_what_gel_adds_is_found(by_gel_db, black, rng):
    """Blurred, bright tissue seems to begin up to 0.5 mm early. Columns without contact, black all the way, are no bare skin."""
    images = scans(NIPPLE, by_gel_db, rng)
    if black:
        images[..., -40:] = 0
    found = factors(images)
    np.testing.assert_allclose(10 * np.log10(found[:, SEEN]) - decibels(by_gel_db), 0, atol=0.2 + 0.5 * by_gel_db)
    assert (found[:, NIPPLE < TOP_MM - 0.5] == 1).all(), "gel within the ringing isn't seen"


@pytest.mark.parametrize(("by_gel_db", "mass_db"), [(0.0, 6.0), (0.4, -14.0)])
def test_a_mass_behind_gel_is_none_of_it(by_gel_db, mass_db, rng):
    """10 mm of some 30: the rest of the depths tells what the gel adds."""
    images = scans(NIPPLE, by_gel_db, rng)
    inside = np.hypot(U_MM - 6, V_MM - 18) < 5
    images[:, inside] = np.clip(images[:, inside] + mass_db * 255 / 60, 0, 255)
    np.testing.assert_allclose(10 * np.log10(factors(images)[:, SEEN]) - decibels(by_gel_db), 0, atol=0.3 + 0.5 * by_gel_db)


@pytest.mark.parametrize("level_db", [-8.0, -10.0])
def test_what_is_dark_below_the_ringing_is_no_gel(level_db, rng):
    """A layer of fat, or a mass, with 4 dB more behind it."""
    images = scans(0 * U_MM, 0.0, rng)
    under = np.abs(U_MM - 10) < 5
    for where, by_db in (((V_MM < 8) & under, level_db), ((V_MM >= 8) & under, 4.0)):
        images[:, where] = np.clip(images[:, where] + by_db * 255 / 60, 0, 255)
    np.testing.assert_allclose(factors(images), 1)


def test_without_gel_nothing_is_brighter(rng):
    """Nor by what is dark all the way down, where the array is lifted off, or in the shadow of something at the face."""
    plain = scans(0 * U_MM, 0.0, rng)
    np.testing.assert_array_equal(factors(plain), 1)
    plain[:, :, :30] = 0
    plain[:, 20:150, 40:60] = 0
    np.testing.assert_array_equal(factors(plain), 1)


def test_scans_without_a_pose_count_nothing(rng):
    """Lifted off, they show anything."""
    images, poses = scans(NIPPLE, 0.5, rng), POSES.copy()
    images[::2], poses[::2] = scans(NIPPLE, 0.0, rng)[::2], np.nan
    some = gel.brightening(lambda: iter(images[1::2]), POSES[1::2], TABLE, TOP)
    np.testing.assert_array_equal(gel.brightening(lambda: iter(images), poses, TABLE, TOP)[1::2], some)


def test_more_or_fewer_images_than_poses_are_refused(rng):
    images = scans(0 * U_MM, 0.0, rng)
    with pytest.raises(InputError, match="images: expected as many as poses, 24, found 23"):
        factors(images[1:])
