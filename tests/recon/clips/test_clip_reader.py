"""DICOM files, videos and folders of images give the frames, times, B-scan's part and scale that were written."""

import os

import cv2
import numpy as np
import pydicom
import pytest
from pydicom.uid import DeflatedExplicitVRLittleEndian, HTJ2KLossless, JPEGBaseline8Bit, JPEGLosslessSV1

from recon.clips import clip_reader, image_region
from recon.clips.dialects import dicom_clip, video_clip
from recon.errors import InputError
from recon.files import video_file
from tests.recon.clips import made_clips
from tests.recon.clips.made_clips import BOX, SCREEN


def frames_of(clip) -> np.ndarray:
    return np.stack(list(clip.stream()))


@pytest.mark.parametrize("kind", ["grey", "colour", "sixteen bits"])
def test_a_dicom_file_gives_its_frames_region_scale_and_times(kind, tmp_path):
    """Of regions the two-dimensional one of tissue counts; a colour picture of greys gives these greys."""
    shown = made_clips.screens(made_clips.scans(5))
    stored = {"grey": shown, "colour": np.repeat(shown[..., None], 3, axis=-1), "sixteen bits": np.uint16(shown) << 8}[kind]
    made_clips.write_dicom(tmp_path / "scan.dcm", stored, FrameTime=50.0)
    clip = clip_reader.read(tmp_path / "scan.dcm")
    assert clip.size == SCREEN and clip.image == BOX and clip.mm_per_px == pytest.approx((0.125, 0.119))
    assert clip.seconds == pytest.approx([0, 0.05, 0.1, 0.15, 0.2])
    assert (frames_of(clip) == shown).all()


@pytest.mark.parametrize(
    ("cut", "expected"),
    [
        ((0, 1), ((40, 30, 120, 95), True)),  # counts from one, as scanners do: a row beyond
        ((120, 90), (BOX, False)),  # half the size, as files shrunk for the web are
    ],
)
def test_a_region_that_oversteps_the_image(cut, expected, tmp_path):
    """A pixel beyond is cut off; farther beyond, the image isn't the region's any more, so that its scale isn't given."""
    width, height = (SCREEN[0] - cut[0], SCREEN[1] - cut[1]) if cut[0] else (BOX[0] + BOX[2], BOX[1] + BOX[3] - 1)
    made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.screens(made_clips.scans(2))[:, :height, :width], FrameTime=50.0)
    clip = clip_reader.read(tmp_path / "scan.dcm")
    assert (clip.image, clip.mm_per_px is not None) == expected


@pytest.mark.parametrize(
    ("tags", "seconds"),
    [
        ({"FrameTimeVector": [0, 40, 60], "FrameTime": 10}, [0, 0.04, 0.1]),
        ({"CineRate": 25}, [0, 0.04, 0.08]),
        ({"RecommendedDisplayFrameRate": 50}, [0, 0.02, 0.04]),
        ({}, None),
    ],
)
def test_times_are_the_most_exact_that_the_file_has(tags, seconds, tmp_path):
    made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.scans(3), region=False, **tags)
    clip = clip_reader.read(tmp_path / "scan.dcm")
    assert clip.image is None and clip.mm_per_px is None
    assert clip.seconds is None if seconds is None else clip.seconds == pytest.approx(seconds)


def compressed(path, frames, syntax) -> None:
    """A file whose frames are JPEG, whatever its header says."""
    made_clips.write_dicom(path, frames, region=False, FrameTime=50)
    encoded = [cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes() for frame in frames]
    made_clips.compress(path, encoded, syntax)


def test_grey_levels_are_those_that_the_file_means(tmp_path):
    """Of a palette its colours, of MONOCHROME1 the complement: neither is what is stored."""
    stored = np.arange(64, dtype=np.uint8).reshape(1, 8, 8)
    made_clips.write_dicom(tmp_path / "inverse.dcm", stored, region=False, PhotometricInterpretation="MONOCHROME1")
    assert (frames_of(clip_reader.read(tmp_path / "inverse.dcm")) == 255 - stored).all()
    white_to_black = (np.arange(256, dtype=np.uint16)[::-1] * 257).tobytes()
    palette = {f"{colour}PaletteColorLookupTableData": white_to_black for colour in ("Red", "Green", "Blue")}
    palette |= {f"{colour}PaletteColorLookupTableDescriptor": [256, 0, 16] for colour in ("Red", "Green", "Blue")}
    made_clips.write_dicom(tmp_path / "palette.dcm", stored, region=False, PhotometricInterpretation="PALETTE COLOR", **palette)
    assert (frames_of(clip_reader.read(tmp_path / "palette.dcm")) == 255 - stored).all()


@pytest.mark.parametrize("change", [{"NumberOfFrames": -5}, {"NumberOfFrames": 0}])
def test_frames_are_counted(change, tmp_path):
    made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.scans(2), **change)
    with pytest.raises(InputError, match=r"scan\.dcm"):
        frames_of(clip_reader.read(tmp_path / "scan.dcm"))


def test_a_region_turned_round_or_without_a_scale_is_left_out(tmp_path):
    reversed_, scaleless = made_clips.region_of((20, 20, -6, -8), 1, 1), made_clips.region_of(BOX, 1, 1)
    scaleless.PhysicalDeltaX = 0.0
    for region, image in ((reversed_, None), (scaleless, BOX)):
        regions = {"SequenceOfUltrasoundRegions": pydicom.sequence.Sequence([region])}
        made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.screens(made_clips.scans(2)), **regions)
        clip = clip_reader.read(tmp_path / "scan.dcm")
        assert clip.image == image and clip.mm_per_px is None


def test_jpeg_in_a_dicom_file_is_read(tmp_path):
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 3) for image in made_clips.scans(3)])
    compressed(tmp_path / "scan.dcm", smooth, JPEGBaseline8Bit)
    assert np.abs(np.int32(frames_of(clip_reader.read(tmp_path / "scan.dcm"))) - smooth).max() <= 4


@pytest.mark.parametrize("kind", ["grey", "colour", "sixteen bits"])
def test_lossless_jpeg_in_a_dicom_file_is_read_to_the_last_bit(kind, tmp_path):
    """As GDCM writes it."""
    shown = made_clips.screens(made_clips.scans(3))
    colours = np.stack([shown, np.roll(shown, 1, axis=1), shown // 2], axis=-1)
    stored = {"grey": shown, "colour": colours, "sixteen bits": np.uint16(shown) * 257}[kind]
    made_clips.write_dicom(tmp_path / "plain.dcm", stored, FrameTime=50)
    made_clips.write_dicom(tmp_path / "scan.dcm", stored, FrameTime=50)
    encoded = [made_clips.lossless_jpeg(tmp_path / "frame.dcm", frame) for frame in stored]
    made_clips.compress(tmp_path / "scan.dcm", encoded, JPEGLosslessSV1)
    plain, read = (clip_reader.read(tmp_path / name) for name in ("plain.dcm", "scan.dcm"))
    assert read.image == BOX and (frames_of(read) == frames_of(plain)).all()


def test_colours_that_share_their_chroma_are_read_frame_by_frame(tmp_path):
    """YBR_FULL_422, uncompressed: of each two pixels both lumas and one chroma, two bytes a pixel."""
    shown = made_clips.screens(made_clips.scans(5))
    made_clips.write_dicom(tmp_path / "scan.dcm", np.repeat(shown[..., None], 3, axis=-1), FrameTime=50)
    held = pydicom.dcmread(tmp_path / "scan.dcm")
    pairs = np.full((*shown.shape[:2], SCREEN[0] // 2, 4), 128, np.uint8)
    pairs[..., 0], pairs[..., 1] = shown[..., 0::2], shown[..., 1::2]
    held.PixelData, held.PhotometricInterpretation = pairs.tobytes(), "YBR_FULL_422"
    held.save_as(tmp_path / "scan.dcm")
    clip = clip_reader.read(tmp_path / "scan.dcm")
    assert clip.image == BOX and (frames_of(clip) == shown).all()


def test_a_file_that_is_deflated_is_unpacked_up_to_a_bound(tmp_path, monkeypatch):
    """All of it but the first tags is packed."""
    shown = made_clips.screens(made_clips.scans(5))
    made_clips.write_dicom(tmp_path / "scan.dcm", shown, FrameTime=50.0)
    held = pydicom.dcmread(tmp_path / "scan.dcm")
    held.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    held.save_as(tmp_path / "deflated.dcm")
    assert (tmp_path / "deflated.dcm").stat().st_size < (tmp_path / "scan.dcm").stat().st_size
    clip = clip_reader.read(tmp_path / "deflated.dcm")
    assert clip.image == BOX and (frames_of(clip) == shown).all()
    monkeypatch.setattr(dicom_clip, "MOST_UNPACKED", shown.nbytes)  # the tags come on top
    for attempt in (lambda: clip_reader.read(tmp_path / "deflated.dcm"), lambda: frames_of(clip)):
        with pytest.raises(InputError, match=r"deflated\.dcm: expected up to 0 MiB .* found more: save it uncompressed$"):
            attempt()


def test_a_compression_that_cant_be_read_is_named(tmp_path):
    compressed(tmp_path / "scan.dcm", made_clips.scans(3), HTJ2KLossless)  # JPEG-LS is read where pyjpegls is installed
    with pytest.raises(InputError, match=r"scan\.dcm: TransferSyntaxUID: .* or JPEG 2000, found High-Throughput.*: gdcmconv"):
        clip_reader.read(tmp_path / "scan.dcm")


def test_a_clip_of_any_size_is_recognised_and_a_dicom_file_bounded(tmp_path, monkeypatch):
    """A video may be larger than any DICOM file that is read; its name's ending counts, whatever is in it."""
    made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.scans(2), FrameTime=50.0)
    (tmp_path / "long.mpg").write_bytes((tmp_path / "scan.dcm").read_bytes())
    (tmp_path / "other").write_bytes(bytes(200))
    monkeypatch.setattr(dicom_clip, "MOST_BYTES", 100)
    assert [dicom_clip.recognises(tmp_path / name) for name in ("scan.dcm", "long.mpg", "other")] == [True, False, False]
    with pytest.raises(InputError, match=r"scan\.dcm: expected a file of up to"):
        clip_reader.read(tmp_path / "scan.dcm")
    with pytest.raises(InputError, match=r"long\.mpg: expected a video"):
        clip_reader.read(tmp_path / "long.mpg")


def test_damaged_files_are_refused_by_name(tmp_path):
    made_clips.write_dicom(tmp_path / "scan.dcm", made_clips.scans(3), FrameTime=50)
    content = (tmp_path / "scan.dcm").read_bytes()
    for name, some in {"short": content[:-5000], "none": b"no dicom at all", "empty": b"", "header": content[:300]}.items():
        (tmp_path / name).write_bytes(some)
        with pytest.raises(InputError, match=f"{name}: "):
            frames_of(clip_reader.read(tmp_path / name))
    with pytest.raises(InputError, match=r"gone\.dcm: expected a file, found none"):
        clip_reader.read(tmp_path / "gone.dcm")
    made_clips.write_dicom(tmp_path / "back.dcm", made_clips.scans(3), FrameTimeVector=[0, 40, -10])
    with pytest.raises(InputError, match=r"frame 2: expected a time after .* give rate_hz"):
        clip_reader.read(tmp_path / "back.dcm")


@pytest.mark.parametrize("packed", [False, True])
def test_flipped_bytes_never_end_in_a_traceback(packed, tmp_path):
    """Any damage is refused in one line, or leaves frames of the size that the header has."""
    small = made_clips.scans(2, (16, 12))
    made_clips.write_dicom(tmp_path / "scan.dcm", small, FrameTime=50)
    if packed:
        encoded = [made_clips.lossless_jpeg(tmp_path / "frame.dcm", frame) for frame in small]
        made_clips.compress(tmp_path / "scan.dcm", encoded, JPEGLosslessSV1)
    content, rng = np.frombuffer((tmp_path / "scan.dcm").read_bytes(), np.uint8), np.random.default_rng(1)
    for _ in range(150):
        spoilt = content.copy()
        spoilt[rng.integers(128, len(spoilt), 3)] = rng.integers(0, 256, 3)
        (tmp_path / "spoilt.dcm").write_bytes(spoilt.tobytes())
        try:
            clip = clip_reader.read(tmp_path / "spoilt.dcm")
            assert all(frame.ndim == 2 and frame.dtype == np.uint8 for frame in clip.stream())
        except InputError as error:
            assert str(tmp_path / "spoilt.dcm") in str(error) and "\n" not in str(error)


def test_a_video_gives_its_frames_and_times(tmp_path):
    shown = np.stack([cv2.GaussianBlur(image, (0, 0), 4) for image in made_clips.screens(made_clips.scans(6))])
    made_clips.write_video(tmp_path / "screen.avi", shown, 25.0)
    clip = clip_reader.read(tmp_path / "screen.avi")
    assert clip.size == SCREEN and clip.seconds == pytest.approx(np.arange(6) / 25)
    assert np.abs(np.float64(frames_of(clip)) - shown).mean() < 2
    assert [stamp for stamp, _, _ in video_clip._frames(tmp_path / "screen.avi")] == pytest.approx(np.arange(6) / 25), (
        "not even by the rate"
    )
    (tmp_path / "screen.avi").rename(tmp_path / "screen.MKV")
    assert clip_reader.read(tmp_path / "screen.MKV").count == 6
    (tmp_path / "none.mp4").write_bytes(b"none")
    with pytest.raises(InputError, match=r"none\.mp4: expected a video"):
        clip_reader.read(tmp_path / "none.mp4")


@pytest.mark.parametrize(
    ("given", "used"),
    [
        (None, "protocol_whitelist;file"),
        ("threads;1|flags;low_delay", "threads;1|flags;low_delay|protocol_whitelist;file"),
        ("protocol_whitelist;file,crypto", "protocol_whitelist;file,crypto"),
    ],
)
def test_a_video_names_no_files_far_away_whatever_else_is_asked_for(given, used, tmp_path, monkeypatch):
    """And the environment, which other processes inherit, stays as it was."""
    if given is None:
        monkeypatch.delenv(video_file.OPTIONS, raising=False)
    else:
        monkeypatch.setenv(video_file.OPTIONS, given)
    made_clips.write_video(tmp_path / "screen.avi", made_clips.screens(made_clips.scans(2)))
    seen, plain = [], cv2.VideoCapture

    def opened(*arguments):
        seen.append(os.environ.get(video_file.OPTIONS))
        return plain(*arguments)

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    before = dict(os.environ)
    assert len(frames_of(clip_reader.read(tmp_path / "screen.avi"))) == 2
    assert set(seen) == {used} and dict(os.environ) == before


def test_a_folder_of_images_is_a_clip_without_times(tmp_path):
    shown = made_clips.scans(11)
    for number, image in enumerate(shown):
        cv2.imwrite(str(tmp_path / f"{number}.bmp"), image)
    clip = clip_reader.read(tmp_path)
    assert clip.seconds is None and (frames_of(clip) == shown).all()


@pytest.mark.parametrize("moved", [(0, 0), (-30, 20), (60, -20)])
def test_the_b_scan_is_what_changes_on_the_screen(moved):
    """Wherever it is; texts, frames and a running clock aren't."""
    shown = np.roll(made_clips.screens(made_clips.scans(12)), moved[::-1], axis=(1, 2))
    u, v, width, height = BOX
    assert image_region.find(shown, "screen", "crop=...") == pytest.approx((u + moved[0], v + moved[1], width, height), abs=2)


@pytest.mark.parametrize(("above", "belongs"), [
    ((0, 0, 255, 210, 90), True),  # rows of the face's ringing, which never change
    ((200, 0, 0), False),  # a line apart from it
    ((255,), True),
])  # fmt: skip
def test_the_ringing_of_the_face_belongs_to_the_b_scan(above, belongs):
    """It is about as wide as the B-scan; what is wider is a frame or a header, and a bright background is on all sides."""
    u, v, width, height = BOX
    plain = np.zeros((12, *made_clips.SCREEN[::-1]), np.uint8)
    plain[:, v : v + height, u : u + width] = made_clips.scans(12)
    rows = np.array(above, np.uint8)[None, :, None]
    ringing, wider, bright = plain.copy(), plain.copy(), np.maximum(plain, 40)
    ringing[:, v - len(above) : v, u : u + width] = rows
    wider[:, v - len(above) : v, u - 8 : u + width + 8] = rows
    with_rows = np.count_nonzero(above) if belongs else 0
    expected = (u, v - with_rows, width, height + with_rows)
    assert image_region.find(ringing, "screen", "crop=...") == expected
    assert image_region.find_below_ringing(ringing, "screen", "clip=...") == BOX
    assert image_region.find(wider, "screen", "crop=...") == BOX
    assert image_region.find(bright, "screen", "crop=...") == BOX


def panel(*above: tuple[int, int]) -> np.ndarray:
    """Screens : (n, h, w), black but for the B-scan and rows above it, as wide, by their number and grey level from the top."""
    u, v, width, height = BOX
    shown = np.zeros((12, *made_clips.SCREEN[::-1]), np.uint8)
    shown[:, v : v + height, u : u + width] = made_clips.scans(12)
    levels = np.repeat([level for _, level in above], [count for count, _ in above])
    shown[:, v - len(levels) : v, u : u + width] = levels[:, None]
    return shown


@pytest.mark.parametrize(("above", "rings"), [
    ([(24, 60)], 0),
    ([(4, 60)], 0),
    ([(24, 255)], 0),  # far higher than any ringing
    ([(24, 60), (1, 255), (1, 210), (1, 90)], 3),
    ([(1, 60), (1, 255), (1, 120), (1, 180)], 3),  # it fades by ripples
])  # fmt: skip
def test_a_title_as_wide_as_the_b_scan_is_no_ringing(above, rings):
    """Ringing is brightest at the face, and takes up a little of the depth."""
    u, v, width, height = BOX
    assert image_region.find(panel(*above), "screen", "crop=...") == (u, v - rings, width, height + rings)


@pytest.mark.parametrize(("left", "right"), [(1, 0), (2, 2), (0, 5), (5, 5)])
def test_ends_of_the_array_without_contact_belong_to_the_b_scan(left, right):
    """They ring like the rest of the face, and nothing changes below them."""
    u, v, width, height = BOX
    shown = panel((1, 255), (1, 210), (1, 90))
    shown[:, v:, : u + left], shown[:, v:, u + width - right :] = 0, 0
    assert image_region.find(shown, "screen", "crop=...") == (u, v - 3, width, height + 3)
    assert image_region.find_below_ringing(shown, "screen", "clip=...") == (u + left, v, width - left - right, height)


@pytest.mark.parametrize("level", [90, 255])
def test_a_frame_is_no_end_without_contact(level):
    """Its sides go on below; one that is darker than the face hides no ringing."""
    u, v, width, height = BOX
    for rows in (0, 3):
        shown = panel(*[(1, 255), (1, 210), (1, 90)][:rows])
        for screen in shown:
            cv2.rectangle(screen, (u - 1, v - rows - 1), (u + width, v + height), level)
        found = rows if level < 255 else 0
        assert image_region.find(shown, "screen", "crop=...") == (u, v - found, width, height + found)


@pytest.mark.parametrize("level", [60, 255])
@pytest.mark.parametrize("rows", [3, 60])
def test_a_header_of_a_clip_as_wide_as_its_b_scan_is_no_ringing(rows, level):
    """There nothing beside it shows that the header isn't wider."""
    scans = made_clips.scans(12)
    header = np.full((12, rows, scans.shape[2]), level, np.uint8)
    scans = np.concatenate([np.zeros((12, 60 - rows, scans.shape[2]), np.uint8), header, scans], axis=1)
    assert image_region.find(scans, "clip", "crop=...") == (0, 60, *BOX[2:])


def test_a_clip_that_is_all_b_scan_stays_whole():
    assert image_region.find(made_clips.scans(8), "clip", "crop=...") == (0, 0, *BOX[2:])
    with pytest.raises(InputError, match=r"still: expected a B-scan that changes .* give crop"):
        image_region.find(np.repeat(made_clips.scans(1), 5, axis=0), "still", "crop=...")
