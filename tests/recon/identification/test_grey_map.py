"""Grey maps by the spread of speckle."""

import numpy as np

from recon.identification import grey_map

BLOCKS = 24


def counts_of(power_db, greys_of, rng, looks=1, blocks=BLOCKS, size=300, repeats=4):
    """Histograms : (k, b, 256) of speckle of bands' levels : (b,), each value repeated as in a grain."""
    found = np.zeros((blocks, len(power_db), 256))
    for k in range(blocks):
        for b, level in enumerate(power_db):
            db = level + 10 * np.log10(rng.gamma(looks, 1 / looks, size))
            greys = np.clip(np.rint(greys_of(db)), 0, 255).astype(int)
            found[k, b] = repeats * np.bincount(greys, minlength=256)
    return found


def test_dynamic_range_covers_the_truth(rng):
    """40 recordings that clip at both ends; z is standard normal: its rms errs by 0.11, 3 of these pass."""
    z = []
    for _ in range(40):
        wide, levels = rng.uniform(45, 80), rng.uniform(-38, -6, 4)
        found = grey_map.fit_line(np.arange(4.0), counts_of(levels, lambda db, wide=wide: 255 * (1 + db / wide), rng))
        z.append((found.dynamic_range_db / wide - 1) / np.sqrt(found.covariance[0, 0]))
        assert np.abs(found.level_db - levels).max() < 1.5
    assert 0.65 < np.sqrt(np.mean(np.square(z))) < 1.35


def test_a_bent_map_is_found_from_patches_of_overlapping_levels(rng):
    """An S-shaped map over 60 dB, to 1 dB from the darkest tenth to the brightest."""

    def bent(db):
        share = np.clip(1 + db / 60, 0, 1)
        return 255 * (3 * share**2 - 2 * share**3)

    levels = rng.uniform(-50, -5, 120)
    counts = counts_of(levels, bent, rng, blocks=1, size=400)[0]
    knots = np.r_[1, 4, np.arange(10, 250, 12), 252] + 0.5
    curve, found = grey_map.fit_curve(counts, knots)
    db = np.linspace(-54, -6, 400)
    back = curve.db_of(bent(db))
    error = back - db
    assert np.abs(error - np.median(error)).max() < 1.0
    assert (found - levels).std() < 0.5
