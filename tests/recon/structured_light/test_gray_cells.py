"""Gray code alone: do cells hold the coordinates that pixels see, and are images in a wrong order refused?"""

import numpy as np
import pytest

from recon.errors import InputError
from recon.model.patterns import GrayCode, Patterns, Uniform
from recon.structured_light.decode import Status, decode
from recon.structured_light.plausibility import CodeOutside
from tests.recon.fringe_scenes import breast, photograph

SIZE = (1280, 800)
CODES = [(1, 11), (2, 10), (4, 9), (16, 7)]  # pitch, px, and bits


def sequence(pitch=1, bits=11, inverted=True, axes=("columns", "rows"), **fields):
    code = tuple(GrayCode(axis=axis, pitch=pitch, bits=bits, inverted=inverted, **fields) for axis in axes)
    return Patterns(projector_size=SIZE, unwrap="gray", parts=code if inverted else (Uniform(level=0), *code, Uniform()))


def slanted():
    """Both coordinates of a wavy surface, by which pixels see all parts of cells."""
    v, u = np.mgrid[:300, :400].astype(float)
    return {"columns": 200 + 1.5 * u + 0.13 * v + 20 * np.sin(v / 40), "rows": 90 + 1.7 * v - 0.07 * u}


@pytest.mark.parametrize("inverted", [True, False], ids=["with inverses", "with black and white"])
@pytest.mark.parametrize(("pitch", "bits"), CODES)
def test_pixels_lie_in_their_cells(rng, pitch, bits, inverted):
    """Both axes, every pixel, wherever the code begins; evenly spread over the cells, as the sigma says."""
    patterns, maps = sequence(pitch, bits, inverted, start=-0.5), slanted()
    found = decode(photograph(patterns, maps, rng), patterns)
    assert found.summary["ok"] == found.status.size and np.isnan(found.phase).all()
    for axis, x, sigma in (("columns", found.columns, found.sigma_columns), ("rows", found.rows, found.sigma_rows)):
        error = x - maps[axis]
        assert np.abs(error).max() < max(0.55 * pitch, 0.8), axis
        assert np.abs(error.mean()) < 0.02 * pitch, "cells' middles"
        assert 0.8 < (error / sigma).std() < 1.02, "by noise pixels at borders are taken for less certain than they are"


def test_the_complementary_bit_halves_the_cells(rng):
    patterns, maps = sequence(8, 8, complementary=True), slanted()
    found = decode(photograph(patterns, maps, rng), patterns)
    assert np.abs(found.columns - maps["columns"]).max() < 2.2
    assert np.median(found.sigma_columns) == pytest.approx(4 / np.sqrt(12))


@pytest.mark.parametrize("blur", [1.5, 2.5])
def test_stripes_too_fine_to_be_seen_make_cells_wider(rng, blur):
    """The projector's defocus wipes out stripes of two pixels, whose bit is lost; next to nothing is wrong then."""
    patterns, maps = sequence(), slanted()
    found = decode(photograph(patterns, maps, rng, blur=blur, light=60.0), patterns)
    assert found.summary["ok"] > 0.99 * found.status.size
    assert np.nanmedian(found.sigma_columns) > 1.99 / np.sqrt(12)
    assert np.nanmean(np.abs(found.columns - maps["columns"]) > 2 * found.sigma_columns) < 0.002


def test_shadows_are_dark_and_edges_right(rng):
    patterns, x = sequence(axes=("columns",)), breast((320, 480))
    found = decode(photograph(patterns, {"columns": x}, rng), patterns)
    assert (found.status[np.isnan(x)] == Status.DARK).all() and found.rows is None
    assert np.nanmax(np.abs(found.columns - x)) < 0.8


def test_overexposed_white_is_no_loss(rng):
    """Bits compare white with black, so that a code may saturate where fringes must not."""
    patterns, maps = sequence(), slanted()
    found = decode(photograph(patterns, maps, rng, light=600.0), patterns)
    assert np.abs(found.columns - maps["columns"]).max() < 1.1


def test_columns_by_fringes_and_rows_by_code(rng):
    """Each axis is decoded by what it has."""
    fringes = {"kind": "fringes", "pitch": 20, "steps": 4, "origin": -0.5}
    code = {"kind": "gray", "pitch": 20, "bits": 6, "start": -0.5, "inverted": True}
    rows = {"kind": "gray", "axis": "rows", "pitch": 1, "bits": 10, "inverted": True}
    patterns, maps = Patterns(projector_size=SIZE, unwrap="gray", parts=(fringes, code, rows)), slanted()
    found = decode(photograph(patterns, maps, rng), patterns)
    assert np.nanstd(found.columns - maps["columns"]) < 0.1 < np.nanstd(found.rows - maps["rows"]) < 0.3


def rearranged(order):
    """Images of a code with inverses whose bits, or pairs of images, are taken in another order."""
    return lambda images: order(images.reshape(-1, 2, *images.shape[1:])).reshape(images.shape)


FAULTS = {
    "finest bit first": (rearranged(lambda pairs: pairs[::-1]), "cells from one pixel to the next: .* the coarsest bit first"),
    "two bits exchanged": (rearranged(lambda pairs: pairs[[0, 1, 2, 4, 3, *range(5, 11)]]), "the code leaps by .* cells"),
    "all bits, then all inverses": (
        lambda images: np.concatenate([images[::2], images[1::2]]),
        "neither black nor white in .* is each image followed by its inverse",
    ),
    "inverses first": (rearranged(lambda pairs: pairs[:, ::-1]), "are they in the manifest's order"),
    "no light": (lambda images: np.full_like(images, 9), "hold no Gray code: expected half of white less black of 4 DN or more"),
    "too much": (lambda images: np.full_like(images, 255), "saturated all over"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_images_out_of_order_are_refused(rng, fault):
    spoil, complaint = FAULTS[fault]
    patterns = sequence(axes=("columns",))
    images = photograph(patterns, {"columns": breast((320, 480))}, rng)
    decode(images, patterns)
    with pytest.raises(InputError, match=complaint) as caught:
        decode(spoil(images), patterns, name="shots")
    assert str(caught.value).startswith("shots: images 0 to 21") and "\n" not in str(caught.value)


def test_another_projector_is_refused(rng):
    """A code that is read well and names places outside the image was made for a larger one."""
    larger = sequence(axes=("columns",))
    images = photograph(larger, {"columns": slanted()["columns"] + 400}, rng)
    smaller = larger.model_copy(update={"projector_size": (912, 1140)})
    with pytest.raises(CodeOutside, match=r"lies beyond the projector's 912 px: .* projector_size"):
        decode(images, smaller)
