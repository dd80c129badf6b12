"""Lossless JPEG is decoded to the last bit, by all predictors and with restarts; what is damaged is refused."""

import struct

import pytest

from recon.clips import lossless_jpeg


def predicted(image, y, x, predictor, anew, first):
    if y == anew:
        return first if x == 0 else image[y, x - 1]
    if x == 0:
        return image[y - 1, 0]
    left, above, between = image[y, x - 1], image[y - 1, x], image[y - 1, x - 1]
    return (
        left, above, between, left + above - between, left + ((above - between) >> 1), above + ((left - between) >> 1),
        (left + above) >> 1,
    )[predictor - 1]  # fmt: skip


def encoded(image, predictor, rows=0, precision=8):
    """A JPEG file of an image, with codes of five bits for the numbers of bits, from 0 to 16; a restart after each `rows`."""
    height, width = image.shape
    scans = []
    for anew in range(0, height, rows or height):
        bits = ""
        for y in range(anew, min(anew + (rows or height), height)):
            for x in range(width):
                step = (
                    int(image[y, x]) - int(predicted(image, y, x, predictor, anew, 1 << (precision - 1))) + 32767
                ) % 65536 - 32767
                size = abs(step).bit_length()
                bits += f"{size:05b}"
                if 0 < size < 16:
                    bits += f"{step if step > 0 else step + (1 << size) - 1:0{size}b}"
        bits += "1" * (-len(bits) % 8)
        packed = bytes(int(bits[k : k + 8], 2) for k in range(0, len(bits), 8))
        scans.append(packed.replace(b"\xff", b"\xff\0"))
    data = b"".join(scan + bytes([0xFF, 0xD0 + k % 8]) for k, scan in enumerate(scans))[:-2]

    def segment(marker, content):
        return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content

    frame = struct.pack(">BHHB3B", precision, height, width, 1, 1, 0x11, 0)
    codes = bytes([0, 0, 0, 0, 0, 17, *[0] * 11, *range(17)])
    parts = [segment(0xC3, frame), segment(0xC4, codes), segment(0xDD, struct.pack(">H", rows * width))]
    scan = segment(0xDA, bytes([1, 1, 0, predictor, 0, 0]))
    return b"\xff\xd8" + b"".join(parts) + scan + data + b"\xff\xd9"


@pytest.mark.parametrize("predictor", range(1, 8))
@pytest.mark.parametrize(("rows", "precision"), [(0, 8), (5, 16)])
def test_all_predictors_give_the_samples(predictor, rows, precision, rng):
    image = rng.integers(0, 1 << precision, (23, 17))
    assert (lossless_jpeg.decode(encoded(image, predictor, rows, precision)) == image).all()


def test_an_image_cut_short_is_refused(rng):
    data = encoded(rng.integers(0, 256, (40, 30)), 1)
    for length in range(2, len(data) - 2, 7):
        with pytest.raises((ValueError, struct.error)):
            lossless_jpeg.decode(data[:length])
