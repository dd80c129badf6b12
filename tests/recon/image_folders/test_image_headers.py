"""Sizes and depths of image files."""

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.image_folders import image_headers


@pytest.fixture
def draw(tmp_path):
    """Write an image of one grey level; returns its path."""

    def draw(name: str, level: int = 0, kind: type = np.uint8, size: tuple[int, int] = (24, 16)):
        assert cv2.imwrite(str(tmp_path / name), np.full(size[::-1], level, kind))
        return tmp_path / name

    return draw


@pytest.mark.parametrize("kind", ["png", "bmp", "tif", "jpg"])
def test_sizes(draw, kind):
    first, second = draw(f"1.{kind}"), draw(f"2.{kind}", size=(16, 24))
    assert image_headers.common_size([first, first]) == (24, 16)
    with pytest.raises(InputError, match=r"2\.\w+: expected 24x16, as .*1\.\w+ of the same camera, found 16x24"):
        image_headers.common_size([first, second])


def test_what_is_no_image_is_refused(tmp_path):
    (tmp_path / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match=r"1\.png: expected an image"):
        image_headers.common_size([tmp_path / "1.png"])


def test_depths(draw):
    """Of 16-bit images by the brightest of all."""
    dark, bright = draw("1.png", 1023, np.uint16), draw("2.png", 1024, np.uint16)
    assert [image_headers.bits(paths) for paths in ([draw("0.png", 255)], [dark], [dark, bright])] == [8, 10, 12]
    with pytest.raises(InputError, match="right-aligned, found values up to 4096"):
        image_headers.bits([draw("3.png", 4096, np.uint16)])
