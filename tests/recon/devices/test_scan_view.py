import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.devices.scan_view import ORIENTATIONS, ScanView
from recon.freehand import sequence_images


def test_the_whole_image_stays_as_it_is(rng):
    image = rng.integers(0, 256, (4, 6), np.uint8)
    np.testing.assert_array_equal(ScanView().of(image), image)
    assert ScanView().size((6, 4)) == (6, 4)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_orientations_are_those_of_sequences(rng, orientation):
    """A recorded sequence and its live stream give the same B-scan."""
    image = rng.integers(0, 256, (4, 6), np.uint8)
    view = ScanView(orientation=orientation)
    found = view.of(image)
    np.testing.assert_array_equal(found, sequence_images._turned(image, orientation))
    assert found.shape == view.size((6, 4))[::-1] and found.flags.c_contiguous


def test_the_crop_is_of_what_is_sent(rng):
    image = rng.integers(0, 256, (40, 60), np.uint8)
    found = ScanView((10, 5, 20, 30), "UN").of(image)
    np.testing.assert_array_equal(found, image[5:35, 10:30][::-1, ::-1])


def test_the_scale_keeps_the_picture():
    """A ramp at half its size is the ramp of every second pixel's middle."""
    image = np.tile(np.arange(0, 200, 2, dtype=np.uint8), (40, 1))
    view = ScanView(scale=0.5)
    assert view.size((100, 40)) == (50, 20)
    np.testing.assert_array_equal(view.of(image)[3], np.arange(1, 200, 4))


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"orientation": "XY"}, "orientation: expected one of MF"),
        ({"scale": 0.0}, "scale: expected 0.05 to 4"),
        ({"scale": float("nan")}, "scale"),
        ({"crop": (0, 0, 0, 5)}, "crop: expected"),
        ({"crop": (-1, 0, 5, 5)}, "crop: expected"),
    ],
)
def test_impossible_views_are_refused(fields, match):
    with pytest.raises(DeviceError, match=match):
        ScanView(**fields)


def test_crops_outside_the_image_are_refused():
    with pytest.raises(DeviceError, match="part of the image of 60x40 px, found"):
        ScanView((50, 0, 20, 10)).size((60, 40))
