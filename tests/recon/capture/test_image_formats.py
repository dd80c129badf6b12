"""Images: the pixels that OpenCV decodes, and no file that breaks the decoder or makes a library speak."""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from recon.capture.image_formats import MOST_PX, decode_image, size_of
from recon.errors import InputError
from tests.recon import bounded_work
from tests.recon.files.mutations import damaged

PLACE = Path("image")
GREY = np.random.default_rng(0).integers(0, 256, (24, 40), dtype=np.uint8)
DEEP = np.random.default_rng(1).integers(0, 65536, (24, 40), dtype=np.uint16)
COLOUR = np.random.default_rng(2).integers(0, 256, (24, 40, 3), dtype=np.uint8)


def pillow(pixels: np.ndarray, kind: str, mode: str | None = None, **more) -> bytes:
    stream = BytesIO()
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(stream, kind, **more)
    return stream.getvalue()


def opencv(pixels: np.ndarray, suffix: str) -> bytes:
    return cv2.imencode(suffix, pixels)[1].tobytes()


def chunks(*pieces: tuple[bytes, bytes]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in pieces
    )


def header(width: int, height: int, depth: int = 8, colour: int = 0) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)


def packed(bits: int) -> bytes:
    """Grey levels of a few bits, several a byte."""
    rows = np.random.default_rng(bits).integers(0, 256, (24, 1 + 40 * bits // 8), dtype=np.uint8)
    rows[:, 0] = 0
    return chunks(header(40, 24, bits), (b"IDAT", zlib.compress(rows.tobytes())), (b"IEND", b""))


def filtered(kind: int) -> bytes:
    """Colours with alpha in rows of one filter, and some of others."""
    rows = np.random.default_rng(kind).integers(0, 256, (24, 1 + 4 * 40), dtype=np.uint8)
    rows[:, 0], rows[::5, 0] = kind, np.arange(5)
    return chunks(header(40, 24, 8, 6), (b"IDAT", zlib.compress(rows.tobytes())), (b"IEND", b""))


def big_endian(grey: np.ndarray) -> bytes:
    """A BigTIFF file of grey levels, in the order of bytes that Pillow doesn't write."""
    height, width = grey.shape
    fields = (256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 16), (277, 1), (278, height), (279, grey.size)
    table = b"".join(struct.pack(">HHQHxxxxxx", tag, 3, 1, value) for tag, value in fields)
    end = struct.pack(">Q", len(fields)) + table + bytes(8)
    return struct.pack(">2sHHHQ", b"MM", 43, 8, 0, 16 + grey.size) + grey.tobytes() + end


FILES = {
    **{f"grey{suffix}": opencv(GREY, suffix) for suffix in (".png", ".bmp", ".tif", ".jpg")},
    **{f"colour{suffix}": opencv(COLOUR, suffix) for suffix in (".png", ".bmp", ".tif", ".jpg")},
    **{f"deep{suffix}": opencv(DEEP, suffix) for suffix in (".png", ".tif")},
    "deep colour.png": opencv(np.dstack([DEEP, DEEP[::-1], DEEP]), ".png"),
    "deep alpha.png": opencv(np.dstack([DEEP, DEEP[::-1], DEEP, DEEP]), ".png"),
    "alpha.png": opencv(np.dstack([COLOUR, GREY]), ".png"),
    "palette.png": pillow(COLOUR, "png", "P"),
    "bits.png": pillow(GREY, "png", "1"),
    "grey and alpha.png": pillow(GREY, "png", "LA"),
    "deep colour.tif": opencv(np.dstack([DEEP, DEEP[::-1], DEEP]), ".tif"),
    **{f"{bits} bits.png": packed(bits) for bits in (1, 2, 4)},
    **{f"filter {kind}.png": filtered(kind) for kind in range(5)},
    "filtered.png": pillow(np.repeat(np.arange(40, dtype=np.uint8)[None], 24, 0), "png", optimize=True),
    "progressive.jpg": pillow(COLOUR, "jpeg", progressive=True, quality=95),
    "packed.tif": pillow(GREY, "tiff", compression="tiff_lzw"),
    "big.tif": pillow(GREY, "tiff", big_tiff=True),
    "big deep.tif": pillow(DEEP, "tiff", big_tiff=True),
    "big, the other order.tif": big_endian(GREY),
    "trailer.jpg": opencv(GREY, ".jpg") + b"SEFT of a phone, with a preview " + opencv(GREY[:8, :8], ".jpg") + bytes(500),
}


@pytest.mark.parametrize("name", FILES)
def test_pixels_are_those_that_opencv_decodes(name):
    expected = cv2.imdecode(np.frombuffer(FILES[name], np.uint8), cv2.IMREAD_UNCHANGED)
    if name == "grey and alpha.png":  # OpenCV makes three equal colours of it
        expected = expected[..., 0]
    found = decode_image(PLACE, FILES[name])
    assert found.dtype == expected.dtype and found.flags.writeable
    np.testing.assert_array_equal(found, expected if expected.ndim == 2 else expected[..., :3])
    assert size_of(PLACE, BytesIO(FILES[name])) == (40, 24)


ROWS = zlib.compress(bytes(9 * 8))


DAMAGED, NONE = "expected a whole image, found damaged data in it", "expected an image (.png"


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (
            chunks(header(100_000, 100_000), (b"IDAT", ROWS), (b"IEND", b"")),
            f"expected an image of up to {MOST_PX} px",
        ),
        (chunks(header(0, 8), (b"IDAT", ROWS), (b"IEND", b"")), NONE),
        (chunks(header(8, 8), (b"IDAT", ROWS[:-6]), (b"IEND", b"")), DAMAGED),
        (chunks(header(8, 9), (b"IDAT", ROWS), (b"IEND", b"")), DAMAGED),
        (chunks(header(8, 8), (b"IDAT", b"no rows"), (b"IEND", b"")), DAMAGED),
        (chunks(header(8, 8), (b"IDAT", zlib.compress(bytes([9]) * 72)), (b"IEND", b"")), DAMAGED),
        (chunks(header(8, 8, 7), (b"IDAT", ROWS), (b"IEND", b"")), NONE),
        (chunks(header(8, 8, 16, 2), (b"IDAT", ROWS), (b"IEND", b"")), DAMAGED),
        (chunks(header(8, 8), (b"IEND", b"")), DAMAGED),
        (chunks((b"IDAT", ROWS), (b"IEND", b"")), NONE),
        (chunks(header(8, 8), (b"IDAT", ROWS)), "expected a whole PNG image, found it cut short at "),
        (chunks(header(8, 8), (b"IDAT", ROWS), (b"IEND", b""))[:-30] + bytes(30), "expected a whole PNG image, found "),
        (b"BM" + bytes(16) + struct.pack("<ii", 100_000, 100_000) + bytes(40), "expected an image"),
        (b"RIFF....WEBP", NONE),
        (b"\xff\xd8\xff\xe0\xff\xd9", NONE),
        (b"", "expected an image (.png, .bmp, .tif, .tiff, .jpg, .jpeg), found an empty file"),
    ],
)
def test_images_that_are_none_are_refused_in_one_line(data, complaint, capfd):
    with pytest.raises(InputError) as refusal:
        decode_image(PLACE, data)
    assert str(refusal.value).startswith(f"image: {complaint}"), refusal.value
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("more", [{}, {"progressive": True}, {"restart_marker_rows": 1}])
@pytest.mark.parametrize("filled", [b"", bytes(4000), b"\xff" * 500, b"a trailer" * 60, opencv(GREY, ".jpg")])
def test_a_jpeg_cut_short_is_refused_whatever_follows(more, filled):
    """Pillow alone takes zeros, or another image, for the rest of the pixels; an end in a preview before them is none."""
    preview = opencv(GREY[:8, :8], ".jpg")
    image = Image.fromarray(COLOUR)
    stream = BytesIO()
    image.save(stream, "jpeg", quality=90, exif=b"Exif\0\0" + preview, **more)
    whole = stream.getvalue()
    assert decode_image(PLACE, whole + b"a trailer" * 60).shape == COLOUR.shape
    for cut in (1, 2, 3, 17, len(whole) // 3):
        if cut == 1 and filled[:1] == b"\xff":
            continue  # no bytes of the end but these
        with pytest.raises(InputError, match="expected a whole "):
            decode_image(PLACE, whole[:-cut] + filled)


def test_what_no_pixel_is_made_of_is_left_alone(capfd):
    """A colour profile that libpng warns of, and a text that unpacks to a hundred megabytes."""
    odd = (b"iCCP", b"x\0\0" + zlib.compress(b"no profile")), (b"zTXt", b"k\0\0" + zlib.compress(bytes(10**8)))
    found = decode_image(PLACE, chunks(header(8, 8), *odd, (b"IDAT", ROWS), (b"IEND", b"")))
    assert found.shape == (8, 8) and capfd.readouterr() == ("", "")


def mended(data: bytes) -> bytes:
    """A PNG file with right checksums, as far as its chunks can be told apart."""
    result, position = bytearray(data), 8
    while position + 12 <= len(data):
        end = position + 8 + struct.unpack_from(">I", data, position)[0]
        if end + 4 > len(data):
            break
        struct.pack_into(">I", result, end, zlib.crc32(data[position + 4 : end]))
        position = end + 4
    return bytes(result)


@settings(max_examples=250, deadline=None)
@given(data=st.data(), name=st.sampled_from(list(FILES)))
def test_a_damaged_image_is_an_image_or_one_line(data, name):
    spoilt = data.draw(damaged(FILES[name]))
    given = mended(spoilt) if name.endswith("png") and spoilt.startswith(b"\x89PNG") else spoilt
    try:
        with bounded_work.calls(1e5):
            decode_image(PLACE, given)
    except InputError as error:
        assert "\n" not in str(error)


def test_interlaced_images_are_read():
    """A pixel alone, and four of them, by the seven passes of the format."""
    rows = {1: [[0, 9]], 2: [[0, 9], [0, 8], [0, 7, 6]]}  # each with its filter: corner, the one right of it, those below
    for edge, lines in rows.items():
        stream = zlib.compress(bytes(value for row in lines for value in row))
        data = chunks((b"IHDR", struct.pack(">IIBBBBB", edge, edge, 8, 0, 0, 0, 1)), (b"IDAT", stream), (b"IEND", b""))
        assert decode_image(PLACE, data).tolist() == {1: [[9]], 2: [[9, 8], [7, 6]]}[edge]
