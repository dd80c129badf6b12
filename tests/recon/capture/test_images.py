"""Image files of all common kinds are read as grey, as they are stored; what is cut short or of another depth is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import images
from recon.errors import InputError

SIZE = (64, 48)


def picture(deep: bool = False) -> np.ndarray:
    """Colours that differ, each value below full scale; grey where all are alike."""
    top = 1 << 10 if deep else 1 << 8
    return np.random.default_rng(0).integers(0, top - 1, (SIZE[1], SIZE[0], 3)).astype(np.uint16 if deep else np.uint8)


def write(path: Path, pixels: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize(("kind", "deep"), [("png", False), ("bmp", False), ("tif", False), ("tiff", True), ("png", True)])
def test_grey_and_colour_come_back(tmp_path, kind, deep):
    """Grey stays as it is, also where it is stored in three channels; colours become their luma."""
    bits, colours = (10 if deep else 8), picture(deep)
    grey = colours[..., 0]
    for name, stored in (("grey", grey), ("threefold", np.repeat(grey[..., None], 3, axis=2))):
        found = images.read_image(write(tmp_path / f"{name}.{kind}", stored), SIZE, bits)
        assert found.dtype == grey.dtype and np.array_equal(found, grey), name
    luma = colours @ [0.114, 0.587, 0.299]  # blue, green, red: BT.601
    found = images.read_image(write(tmp_path / f"colour.{kind}", colours), SIZE, bits)
    assert np.abs(found - luma).max() <= 1


def test_a_jpeg_comes_back_but_for_its_losses(tmp_path):
    smooth = cv2.GaussianBlur(picture(), (0, 0), 4)
    for pixels in (smooth, smooth[..., 1]):
        found = images.read_image(write(tmp_path / "0000.jpg", pixels), SIZE, 8)
        expected = pixels if pixels.ndim == 2 else pixels @ [0.114, 0.587, 0.299]
        assert np.abs(found.astype(float) - expected).max() < 6


def test_a_jpeg_is_not_turned(tmp_path):
    """A camera that was held upright asks for a turn in the EXIF data; pixels stay where the sensor has them."""
    path = write(tmp_path / "0000.jpg", cv2.GaussianBlur(picture()[..., 1], (0, 0), 4))
    plain = images.read_image(path, SIZE, 8)
    exif = b"Exif\0\0" + bytes.fromhex("4d4d002a00000008000101120003000000010006000000000000")  # orientation 6
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert cv2.imread(str(path)).shape[:2] == SIZE, "OpenCV turns it"
    assert np.array_equal(images.read_image(path, SIZE, 8), plain)


@pytest.mark.parametrize("deep", [False, True])
def test_a_saturated_colour_is_saturated_light(tmp_path, deep):
    """Blue at full scale alone is a luma of 29, by which fringes would seem to be fine."""
    full, colours = (1023 if deep else 255), picture(deep) // 2
    colours[10, 20] = full, 0, 0
    found = images.read_image(write(tmp_path / "0000.png", colours), SIZE, 10 if deep else 8)
    assert found[10, 20] == full and np.count_nonzero(found == full) == 1


@pytest.mark.parametrize("kind", ["png", "bmp", "tif", "jpg"])
def test_a_file_cut_short_is_refused(tmp_path, kind):
    path = write(tmp_path / f"0000.{kind}", picture())
    whole = path.read_bytes()
    for length in (0, 3, len(whole) // 2, len(whole) - 100):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=rf"0000\.{kind}: expected .* found") as caught:
            images.read_image(path, SIZE, 8)
        assert "\n" not in str(caught.value)


def test_another_depth_is_refused(tmp_path):
    path = tmp_path / "0000.tif"
    with pytest.raises(InputError, match="expected 8 or 16 bits a pixel, found float32"):
        images.read_image(write(path, picture().astype(np.float32)), SIZE, 8)
    with pytest.raises(InputError, match="expected 64x48 16-bit, found 64x48 8-bit"):
        images.read_image(write(path, picture()), SIZE, 12)


def test_frames_may_be_of_another_kind(tmp_path):
    """The name of a frame is its number; PNG comes first where there are two."""
    assert images.frame_file(tmp_path, "0007.png") == tmp_path / "0007.png"
    write(tmp_path / "0007.jpg", picture())
    assert images.frame_file(tmp_path, "0007.png") == tmp_path / "0007.jpg"
    write(tmp_path / "0007.png", picture())
    assert images.frame_file(tmp_path, "0007.png") == tmp_path / "0007.png"


def test_names_in_natural_order():
    """A raised two counts as a letter, as no number can be read from it."""
    names = [Path(name) for name in ("10.png", "²", "2.png", "a10", "a9")]
    assert [path.name for path in sorted(names, key=images.natural_key)] == ["2.png", "10.png", "a9", "a10", "²"]
