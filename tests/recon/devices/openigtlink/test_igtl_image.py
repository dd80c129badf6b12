import struct

import numpy as np
import pytest

from recon.devices.openigtlink import igtl_image
from recon.devices.openigtlink.igtl_image import Image
from recon.errors import InputError
from tests.recon.devices.openigtlink.igtl_peers import pose


def test_the_message_has_the_middle_between_the_outermost_pixels_centres():
    """Three pixels 2 mm wide from x = 10: centres at 10, 12, 14, the middle is the second one's; two rows from y = 5: 5.5."""
    ras_from_index = np.diag([2.0, 1.0, 1.0, 1.0])
    ras_from_index[:3, 3] = 10, 5, -3
    content = igtl_image.write(Image(np.zeros((2, 3), np.uint8), ras_from_index))
    *columns, x, y, z = struct.unpack(">12f", content[12:60])
    assert columns == [2, 0, 0, 0, 1, 0, 0, 0, 1] and (x, y, z) == (12, 5.5, -3)
    assert struct.unpack(">H4B3H", content[:12]) == (1, 1, 3, 2, 1, 3, 2, 1)  # uint8, little-endian, RAS, width before height


def test_images_declared_lps_lie_at_the_same_place():
    """Left is minus right, posterior minus anterior: x and y change their signs, columns and rows of pixels don't."""
    content = bytearray(igtl_image.write(Image(np.zeros((4, 6), np.uint8), np.eye(4))))
    place = np.frombuffer(content[12:60], ">f4").reshape(4, 3) * (-1, -1, 1)
    content[12:60] = place.astype(">f4").tobytes()
    content[5] = igtl_image.LPS
    np.testing.assert_allclose(igtl_image.read(memoryview(content)).ras_from_index, np.eye(4), atol=1e-6)


@pytest.mark.parametrize("code", igtl_image.TYPES)
@pytest.mark.parametrize("order", [">", "<"])
def test_levels_of_all_types_in_both_orders_are_read_to_the_byte(rng, code, order):
    levels = rng.integers(0, 100, (3, 4)).astype(np.dtype(igtl_image.TYPES[code]).newbyteorder(order))
    content = bytearray(igtl_image.write(Image(levels.astype(levels.dtype.newbyteorder("=")), np.eye(4))))
    content[4] = igtl_image.BIG if order == ">" else igtl_image.LITTLE
    content[72:] = levels.tobytes()
    np.testing.assert_array_equal(igtl_image.read(memoryview(content)).levels, levels)


@pytest.mark.parametrize(
    ("place", "value", "match"),
    [
        (3, b"\x09", "expected type"),
        (4, b"\x03", "expected type"),
        (5, b"\x00", "expected type"),
        (6, b"\xff\xff", "whole image"),
        (12, b"\x7f\xc0\x00\x00", "finite"),
        (66, b"\x00\x02", "whole image of 6x4x1 pixels, found a part of 2x4x1"),
        (2, b"\x02", "expected the bytes of 6x4x1 pixels of 2 uint8, found 24"),
        (2, b"\x00", "expected the bytes"),
    ],
)
def test_images_that_contradict_themselves_are_refused(place, value, match):
    content = bytearray(igtl_image.write(Image(np.zeros((4, 6), np.uint8), np.eye(4))))
    content[place : place + len(value)] = value
    with pytest.raises(InputError, match=match):
        igtl_image.read(memoryview(content))


def test_a_volume_of_two_hundred_terabytes_takes_no_memory():
    content = igtl_image.HEAD.pack(1, 255, 11, 2, 1, *[65535] * 3, *[1.0] * 12, 0, 0, 0, *[65535] * 3)
    with pytest.raises(InputError, match="found 0"):
        igtl_image.read(memoryview(content))


@pytest.mark.parametrize(
    "levels", [np.zeros((3, 0), np.uint8), np.zeros(3), np.zeros((2, 2), bool), np.zeros((1, 70000), np.uint8)]
)
def test_what_is_no_image_is_refused(levels):
    with pytest.raises(InputError, match="expected an image"):
        igtl_image.write(Image(levels, np.eye(4)))


def test_a_pixel_keeps_its_place(rng):
    """Of a B-scan anywhere, to what the float32 of its middle and its columns allow."""
    ras_from_index = pose(rng) / [[100], [100], [100], [1]]
    image = Image(np.zeros((408, 321), np.uint8), ras_from_index)
    found = igtl_image.read(memoryview(igtl_image.write(image))).ras_from_index
    pixel = [320, 407, 0, 1]
    np.testing.assert_allclose(found @ pixel, ras_from_index @ pixel, rtol=1e-6, atol=2e-4)


def test_a_plane_without_a_thickness_gets_a_normal():
    """2 mm columns along x, 3 mm rows along y: the normal is z, and the pixels stay where they are."""
    flat = np.diag([2.0, 3.0, 0.0, 1.0])
    found = igtl_image.read(memoryview(igtl_image.write(Image(np.zeros((4, 6), np.uint8), flat)))).ras_from_index
    np.testing.assert_allclose(found, np.diag([2.0, 3.0, 1.0, 1.0]), atol=1e-6)
