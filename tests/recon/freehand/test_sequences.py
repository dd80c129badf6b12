"""Sequence files keep what was recorded, read what PLUS writes, and say in one line what is wrong."""

import tracemalloc

import cv2
import nrrd
import numpy as np
import pytest
import SimpleITK
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration

SUFFIXES = [".igs.mha", ".igs.nrrd"]
PROBE = ProbeCalibration(rigid.from_rotation_vector([0.3, -0.2, 1.1], [12, -40, 7]), np.array([0.11, 0.125]))


def random_poses(rng, count):
    return np.array([rigid.transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 200, 3)) for _ in range(count)])


@pytest.fixture
def frames(rng):
    """Five frames, one without an image, one without a pose."""
    valid = {"ProbeToTracker": np.array([1, 1, 0, 1, 1], bool), "Image": np.array([1, 0, 1, 1, 1], bool)}
    return Frames(
        np.sort(rng.uniform(0, 1, 5)) + 1e5 / 3,
        {"ProbeToTracker": random_poses(rng, 5)},
        valid,
        rng.integers(0, 256, (5, 6, 9), np.uint8),
        {"ProbeToTrackerTransformStatus": ("OK", "OK", "OUT_OF_VIEW", "OK", "OK"), "Comment": ("", "a: b", "", "", "ä = 3")},
        {"Patient": "phantom no. 3"},
    )


def assert_same(read: Frames, frames: Frames):
    assert np.array_equal(read.times_s, frames.times_s, equal_nan=True)
    assert read.transforms.keys() == frames.transforms.keys() and read.valid.keys() == frames.valid.keys()
    assert all(np.array_equal(read.transforms[name], frames.transforms[name]) for name in frames.transforms)
    assert all(np.array_equal(read.valid[name], frames.valid[name]) for name in frames.valid)
    assert (read.images is None) == (frames.images is None)
    assert frames.images is None or np.array_equal(read.images, frames.images)
    assert (read.frame_fields, read.fields) == (frames.frame_fields, frames.fields)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_written_is_read_to_the_last_bit(frames, tmp_path, suffix):
    sequences.write_sequence(tmp_path / f"s{suffix}", frames)
    assert_same(sequences.read_sequence(tmp_path / f"s{suffix}"), frames)
    streamed = list(sequences.stream_images(tmp_path / f"s{suffix}"))
    assert np.array_equal(streamed, frames.images)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_tracking_alone_is_kept(frames, tmp_path, suffix):
    tracking = Frames(frames.times_s, frames.transforms, {"ProbeToTracker": frames.valid["ProbeToTracker"]})
    sequences.write_sequence(tmp_path / f"s{suffix}", tracking)
    read = sequences.read_sequence(tmp_path / f"s{suffix}")
    assert read.images is None and list(sequences.stream_images(tmp_path / f"s{suffix}")) == []
    assert np.array_equal(read.transforms["ProbeToTracker"], frames.transforms["ProbeToTracker"])
    assert np.array_equal(read.valid["ProbeToTracker"], frames.valid["ProbeToTracker"])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_streaming_takes_little_memory(rng, tmp_path, suffix):
    """Of 16 MB of images less than 2 MB are in memory at once."""
    images = np.broadcast_to(rng.integers(0, 256, (1, 400, 400), np.uint8), (100, 400, 400))
    frames = sequences.sequence_of(images, random_poses(rng, 100), PROBE, np.arange(100.0))
    sequences.write_sequence(tmp_path / f"s{suffix}", frames)
    tracemalloc.start()
    try:
        total = sum(int(image[0, 0]) for image in sequences.stream_images(tmp_path / f"s{suffix}"))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert total == 100 * int(images[0, 0, 0]) and peak < 2e6


def test_others_read_the_same_pixels_and_poses(frames, tmp_path):
    for suffix in SUFFIXES:
        sequences.write_sequence(tmp_path / f"s{suffix}", frames)
    image = SimpleITK.ReadImage(tmp_path / "s.igs.mha")
    pixels, header = nrrd.read(str(tmp_path / "s.igs.nrrd"), index_order="C")
    assert np.array_equal(SimpleITK.GetArrayFromImage(image), frames.images) and np.array_equal(pixels, frames.images)
    for text in (image.GetMetaData("Seq_Frame0003_ProbeToTrackerTransform"), header["Seq_Frame0003_ProbeToTrackerTransform"]):
        assert np.array_equal(np.array(text.split(), float).reshape(4, 4), frames.transforms["ProbeToTracker"][3])
    assert header["Seq_Frame0002_ProbeToTrackerTransformStatus"] == "OUT_OF_VIEW"


def test_the_real_sweep_is_read_whole(real):
    path = real / "tracked_sweep/SpinePhantomFreehand.igs.mha"
    read = sequences.read_sequence(path)
    assert read.images.shape == (21, 616, 820) and all(valid.all() for valid in read.valid.values())
    peer = SimpleITK.ReadImage(path)
    assert np.array_equal(read.images, SimpleITK.GetArrayFromImage(peer))
    assert set(read.transforms) == {"ProbeToTracker", "ReferenceToTracker", "StylusToTracker"}
    for name, matrices in read.transforms.items():
        texts = [peer.GetMetaData(f"Seq_Frame{k:04d}_{name}Transform") for k in range(21)]
        assert np.array_equal(matrices.reshape(21, 16), [np.array(text.split(), float) for text in texts])
    assert read.times_s[-1] > read.times_s[0] > 200


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_ones_own_images_and_poses_become_a_sequence(rng, tmp_path, suffix):
    """A pixel lies in the world where the probe's calibration and the pose say, also after writing and reading."""
    world_from_target = random_poses(rng, 4)
    world_from_target[2, 0, 3] = np.nan
    images = rng.integers(0, 256, (4, 5, 7), np.uint8)
    sequences.write_sequence(tmp_path / f"s{suffix}", sequences.sequence_of(images, world_from_target, PROBE, np.arange(4) / 30))
    read = sequences.read_sequence(tmp_path / f"s{suffix}")
    world_from_pixel = sequences.poses(read, "Reference", "Image")
    assert np.array_equal(np.isfinite(world_from_pixel[:, 0, 0]), [True, True, False, True])
    for k in (0, 1, 3):
        expected = rigid.apply(world_from_target[k], PROBE.to_target([6, 4]))
        assert np.abs((world_from_pixel[k] @ [6, 4, 0, 1])[:3] - expected).max() < 1e-9


def test_images_poses_and_times_must_be_as_many(rng):
    poses, images = random_poses(rng, 4), np.zeros((4, 5, 7), np.uint8)
    for changed, line in [
        ((images[1:], poses, np.arange(4.0)), "images: expected 4 x height x width of uint8, found"),
        ((images, poses[1:], np.arange(4.0)), "ImageToProbe: expected 4 transforms of 4 x 4"),
        ((images, poses[:, :3], np.arange(4.0)), "world_from_target: expected n poses of 4 x 4, found"),
        ((images.astype(float), poses, np.arange(4.0)), "images: expected 4 x height x width of uint8, found .* of float64"),
    ]:
        with pytest.raises(InputError, match=line):
            sequences.sequence_of(changed[0], changed[1], PROBE, changed[2])


def test_a_chain_goes_through_inverses(rng):
    tracker_from_probe, tracker_from_reference = random_poses(rng, 3), random_poses(rng, 3)
    yes = np.ones(3, bool)
    transforms = {"ProbeToTracker": tracker_from_probe, "ReferenceToTracker": tracker_from_reference}
    frames = Frames(np.arange(3.0), transforms, dict.fromkeys(transforms, yes))
    found = sequences.poses(frames, "Reference", "Image", {"ImageToProbe": sequences.target_from_pixel(PROBE)})
    expected = [
        rigid.invert(r) @ p @ sequences.target_from_pixel(PROBE)
        for p, r in zip(tracker_from_probe, tracker_from_reference, strict=True)
    ]
    assert np.abs(found - expected).max() < 1e-9
    with pytest.raises(InputError, match="expected some that lead from Stylus to Reference, found ProbeToTracker"):
        sequences.poses(frames, "Reference", "Stylus")


PLUS_2D = """ObjectType = Image
NDims = 3
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = False
DimSize = 3 2 2                        
ElementSpacing = 1 1 1
ElementType = MET_UCHAR
UltrasoundImageOrientation = {orientation}
Seq_Frame0000_ProbeToTrackerTransform = 1 0 0 1.5e-005 0 1 0 -2E+002 0 0 1 0 0 0 0 1 
Seq_Frame0000_ProbeToTrackerTransformStatus = OK
Seq_Frame0000_Timestamp = 1.5
Seq_Frame0000_ImageStatus = OK
Seq_Frame0001_ProbeToTrackerTransform = 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1
Seq_Frame0001_ProbeToTrackerTransformStatus = INVALID
Seq_Frame0001_Timestamp = 1.6
Seq_Frame0001_ImageStatus = INVALID
ElementDataFile = LOCAL
"""  # noqa: W291
PIXELS = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
BYTES = PIXELS.tobytes()


def plus_file(tmp_path, text=PLUS_2D, pixels=BYTES, suffix=".igs.mha", orientation="MFA"):
    path = tmp_path / f"plus{suffix}"
    path.write_bytes(text.format(orientation=orientation).encode() + pixels)
    return path


def test_quirks_of_plus(tmp_path):
    """Padded sizes, exponents of three digits, no kinds, statuses, a matrix of zeros where the tool was not seen."""
    read = sequences.read_sequence(plus_file(tmp_path))
    assert np.array_equal(read.images, PIXELS)
    assert np.array_equal(read.transforms["ProbeToTracker"][0, :3, 3], [1.5e-5, -200, 0])
    assert list(read.valid["ProbeToTracker"]) == list(read.valid["Image"]) == [True, False]
    assert list(read.times_s) == [1.5, 1.6]


def test_images_are_turned_so_that_the_marked_side_is_right(tmp_path):
    """As PLUS does: M is the direction in which x grows, F that in which y does."""
    turned = [sequences.read_sequence(plus_file(tmp_path, orientation=o)).images[0] for o in ("MF", "UF", "MN", "UNA")]
    assert [list(image[0]) for image in turned] == [[0, 1, 2], [2, 1, 0], [3, 4, 5], [5, 4, 3]]


@pytest.mark.parametrize(("sizes", "count"), [("3 2 1 2", 12), ("0 0 2", 0), ("1 1 1 2", 2)])
def test_sizes_of_four_axes_and_of_none(tmp_path, sizes, count):
    """Newer PLUS writes a depth of one; tracking alone has images of no pixel or of one, and no status of theirs."""
    kinds = "domain domain domain list" if len(sizes.split()) == 4 else "domain domain list"
    text = PLUS_2D.replace("DimSize = 3 2 2", f"DimSize = {sizes}").replace(
        "NDims = 3", f"NDims = {len(sizes.split())}\nKinds = {kinds}"
    )
    if count < 12:
        text = "\n".join(line for line in text.split("\n") if "ImageStatus" not in line)
    read = sequences.read_sequence(plus_file(tmp_path, text, bytes(range(count))))
    assert (read.images is None) == (count < 12) and len(read.times_s) == 2
    assert read.images is None or np.array_equal(read.images, PIXELS)


def test_nrrd_as_plus_writes_it(tmp_path):
    """Fields of its own with a colon and without an equals sign; the image's status is called Status."""
    text = (
        "NRRD0004\n# Complete NRRD file format specification at:\ntype: unsigned char\ndimension: 3\nspace dimension: 2\n"
        "sizes: 3 2 2          \nspace directions: (1,0) (0,1) none\nkinds: domain domain list\nendian: little\nencoding: raw\n"
        "space origin: (0,0)\nOperator: somebody\nultrasound image orientation:=UF\n"
        "Seq_Frame0000_ProbeToTrackerTransform:=1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\nSeq_Frame0000_Timestamp:=1\n"
        "Seq_Frame0000_Status:=OK\n"
        "Seq_Frame0001_Timestamp:=2\nSeq_Frame0001_Status:=INVALID\n\n"
    )
    read = sequences.read_sequence(plus_file(tmp_path, text, suffix=".igs.nrrd"))
    assert np.array_equal(read.images, PIXELS[:, :, ::-1]) and read.fields == {"Operator": "somebody"}
    assert list(read.valid["Image"]) == list(read.valid["ProbeToTracker"]) == [True, False]


def test_some_frames_have_no_time_stamp(tmp_path):
    read = sequences.read_sequence(plus_file(tmp_path, PLUS_2D.replace("Seq_Frame0000_Timestamp = 1.5\n", "")))
    assert np.array_equal(read.times_s, [np.nan, 1.6], equal_nan=True)
    for suffix in SUFFIXES:
        sequences.write_sequence(tmp_path / f"again{suffix}", read)
        assert_same(sequences.read_sequence(tmp_path / f"again{suffix}"), read)


@pytest.mark.parametrize(("element", "sizes"), [("MET_OTHER", "0 0 2"), ("MET_OTHER", "1 1 2"), ("MET_UCHAR", "0 0 2")])
def test_tracking_alone_as_plus_writes_it_is_written_again(tmp_path, element, sizes):
    """Of no type of pixels, and with a status of images that aren't there."""
    text = PLUS_2D.replace("MET_UCHAR", element).replace("DimSize = 3 2 2", f"DimSize = {sizes}")
    path = plus_file(tmp_path, text, b"")
    read = sequences.read_sequence(path)
    assert read.images is None and list(read.valid) == ["ProbeToTracker"] and read.frame_fields == {}
    assert list(sequences.stream_images(path)) == []
    for suffix in SUFFIXES:
        sequences.write_sequence(tmp_path / f"again{suffix}", read)
        assert_same(sequences.read_sequence(tmp_path / f"again{suffix}"), read)


def test_tracking_alone_as_nrrd_of_plus(tmp_path):
    text = (
        "NRRD0004\ntype: MET_OTHER\ndimension: 3\nsizes: 0 0 1\nkinds: domain domain list\nencoding: raw\n"
        "Seq_Frame0000_ProbeToTrackerTransform:=1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\nSeq_Frame0000_Timestamp:=1\n\n"
    )
    read = sequences.read_sequence(plus_file(tmp_path, text, b"", ".nrrd"))
    assert read.images is None and list(read.valid["ProbeToTracker"]) == [True]


@pytest.mark.parametrize("kinds", ["", "\nKinds = domain domain"])
def test_a_single_image_of_two_axes(tmp_path, kinds):
    text = PLUS_2D.replace("NDims = 3", f"NDims = 2{kinds}").replace("DimSize = 3 2 2", "DimSize = 3 2")
    text = "\n".join(line for line in text.split("\n") if "Frame0001" not in line)
    read = sequences.read_sequence(plus_file(tmp_path, text, BYTES[:6]))
    assert np.array_equal(read.images, PIXELS[:1]) and list(read.times_s) == [1.5]


def test_lines_of_sound_in_rows_become_columns(tmp_path):
    """Far to the right, marked side down: transposed; the other three are turned as well, to the same."""
    shown = PIXELS[0]
    for orientation, stored in [("FM", shown.T), ("FU", shown.T[::-1]), ("NM", shown.T[:, ::-1]), ("NU", shown.T[::-1, ::-1])]:
        text = PLUS_2D.replace("DimSize = 3 2 2", "DimSize = 2 3 2")
        path = plus_file(tmp_path, text, 2 * stored.tobytes(), orientation=orientation)
        assert np.array_equal(sequences.read_sequence(path).images[0], shown) and sequences.image_shape(path) == (2, 3)


@pytest.mark.parametrize(("greatest", "divisor"), [(255, 1), (1023, 4), (1024, 16), (65535, 256)])
@pytest.mark.parametrize("code", ["<u2", ">u2"])
def test_sixteen_bits_become_eight_by_the_greatest_level(tmp_path, greatest, divisor, code):
    """Alike in all images: a scanner's 10 bits in words of 16 are divided by four, though the second image is darker."""
    levels = np.array([0, 1, 100, greatest // 2, greatest - 1, greatest] + 6 * [greatest // 4]).astype(code)
    msb = str(code[0] == ">")
    text = PLUS_2D.replace("MET_UCHAR", "MET_USHORT").replace("ByteOrderMSB = False", f"ByteOrderMSB = {msb}")
    read = sequences.read_sequence(plus_file(tmp_path, text, levels.tobytes()))
    assert np.array_equal(read.images.ravel(), levels // divisor)
    endian = "big" if code[0] == ">" else "little"
    text = f"NRRD0004\ntype: unsigned short\ndimension: 3\nsizes: 3 2 2\nendian: {endian}\nencoding: raw\n\n"
    assert np.array_equal(sequences.read_sequence(plus_file(tmp_path, text, levels.tobytes(), ".nrrd")).images, read.images)


@pytest.mark.parametrize(("greatest", "scale"), [(1, 255), (255, 1), (1023, 0.25), (65535, 1 / 256)])
@pytest.mark.parametrize(("element", "name", "code"), [("MET_FLOAT", "float", "<f4"), ("MET_DOUBLE", "double", "<f8")])
def test_floating_point_levels_are_rounded(tmp_path, greatest, scale, element, name, code, rng):
    """As PLUS's own of 0 to 255, and as fractions."""
    levels = np.append(rng.uniform(0, greatest, 11), greatest).astype(code)
    expected = np.minimum(np.rint(levels * scale), 255)
    read = sequences.read_sequence(plus_file(tmp_path, PLUS_2D.replace("MET_UCHAR", element), levels.tobytes()))
    assert np.array_equal(read.images.ravel(), expected)
    text = f"NRRD0004\ntype: {name}\ndimension: 3\nsizes: 3 2 2\nendian: little\nencoding: raw\n\n"
    assert np.array_equal(sequences.read_sequence(plus_file(tmp_path, text, levels.tobytes(), ".nrrd")).images, read.images)
    levels[3] = np.nan
    with pytest.raises(InputError, match="pixels: expected grey levels below 65536, found nan"):
        sequences.read_sequence(plus_file(tmp_path, PLUS_2D.replace("MET_UCHAR", element), levels.tobytes()))


def element(name: int, content: bytes, open_ended: bool = False) -> bytes:
    """An element of a Matroska file, with its size in eight bytes or left open."""
    size = (1 << 56) - 1 if open_ended else len(content)
    return name.to_bytes((name.bit_length() + 7) // 8, "big") + (size | 1 << 56).to_bytes(8, "big") + content


def matroska_of(frames: Frames, colour: str, open_ended: bool = False) -> bytes:
    """A sequence as PLUS writes it: images as they are, a track of texts for each field, times in ms from the first on."""
    texts = {
        f"{name}Transform": [" ".join(map(repr, m.ravel().tolist())) for m in each] for name, each in frames.transforms.items()
    }
    texts |= {f"{name}TransformStatus": ["OK" if ok else "INVALID" for ok in frames.valid[name]] for name in frames.transforms}
    _, height, width = frames.images.shape
    video = element(0xE0, element(0xB0, bytes([width])) + element(0xBA, bytes([height])) + element(0x2EB524, colour.encode()))
    entries = element(0xAE, element(0xD7, b"\1") + element(0x83, b"\1") + element(0x86, b"V_UNCOMPRESSED") + video)
    for number, name in enumerate(texts, start=2):
        text = element(0xD7, bytes([number])) + element(0x83, b"\x11") + element(0x86, b"S_TEXT/UTF8")
        entries += element(0xAE, text + element(0x536E, name.encode()))
    clusters = b""
    for k, image in enumerate(frames.images):
        pixels = image.tobytes() if colour == "Y800" else np.repeat(image[..., None], 3, axis=2).tobytes()
        blocks = element(0xA3, b"\x81" + bytes(2) + b"\x80" + pixels)
        for number, each in enumerate(texts.values(), start=2):
            blocks += element(0xA0, element(0xA1, bytes([0x80 | number, 0, 0, 0]) + each[k].encode() + b"\0"))
        clusters += element(0x1F43B675, element(0xE7, (50 * k).to_bytes(2, "big")) + blocks, open_ended)
    segment = element(0x1549A966, element(0x2AD7B1, (10**6).to_bytes(3, "big"))) + element(0x1654AE6B, entries) + clusters
    return element(0x1A45DFA3, element(0x4282, b"matroska")) + element(0x18538067, segment, open_ended)


@pytest.mark.parametrize("colour", ["Y800", "RV24"])
@pytest.mark.parametrize("open_ended", [False, True])
def test_a_matroska_file_of_plus_is_read(colour, open_ended, rng, tmp_path):
    """Images to the last bit, transforms by the times of their frames; of a video without them, that none lead anywhere."""
    poses = np.array([rigid.from_rotation_vector([0.1 * k, 0.2, 0], [k, 2, 650]) for k in range(5)])
    valid = {"ProbeToTracker": np.array([True, True, False, True, True])}
    given = Frames(0.05 * np.arange(5), {"ProbeToTracker": poses}, valid, rng.integers(0, 256, (5, 6, 8), np.uint8))
    path = tmp_path / "s.mkv"
    data = matroska_of(given, colour, open_ended)
    path.write_bytes(data)
    read = sequences.read_sequence(path)
    assert np.array_equal(read.images, given.images) and read.times_s == pytest.approx(given.times_s)
    assert np.array_equal(read.transforms["ProbeToTracker"], poses)
    assert read.valid["ProbeToTracker"].tolist() == [True, True, False, True, True] and read.valid["Image"].all()
    for cut in (60, len(data) - 1, *([] if open_ended else [data.rindex(b"\x1f\x43\xb6\x75")])):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=r"s\.mkv: expected a whole Matroska file, found it damaged or cut short at byte"):
            sequences.read_sequence(path)


def test_a_video_in_a_matroska_file_has_images_and_no_poses(tmp_path):
    path = tmp_path / "s.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 20, (64, 48))
    for k in range(6):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    read = sequences.read_sequence(path)
    assert read.times_s == pytest.approx(np.arange(6) / 20, abs=2e-3) and not read.transforms
    assert np.abs(read.images[:, 20, 30].astype(int) - 20 * np.arange(6)).max() <= 2
    with pytest.raises(InputError, match="transforms: expected some in each frame, such as ProbeToTracker"):
        sequences.poses(read, "Reference", "Image")


def test_bytes_of_another_kind_are_named(tmp_path):
    (tmp_path / "s.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(200))
    with pytest.raises(InputError, match=r"s\.mkv: expected a whole Matroska file, found it damaged or cut short at byte 4"):
        sequences.read_sequence(tmp_path / "s.mkv")
    (tmp_path / "s.mha").write_bytes(bytes(range(128, 200)) * 2)
    with pytest.raises(InputError, match=r"s\.mha: expected lines of a MetaImage header, 'name = value', found no text$"):
        sequences.read_sequence(tmp_path / "s.mha")


def test_negative_levels_are_no_image(tmp_path):
    path = plus_file(tmp_path, PLUS_2D.replace("MET_UCHAR", "MET_SHORT"), np.full(12, -5, "<i2").tobytes())
    with pytest.raises(InputError, match=r"pixels: expected grey levels from 0 on, found -5: radio-frequency data\?"):
        sequences.read_sequence(path)


def test_colours_become_their_luminance(tmp_path):
    """Grey ones stay as they are; green is the brightest. By channels in MetaImage, by an axis in NRRD."""
    colours = np.stack([PIXELS] * 3, axis=-1)
    colours[1, 1] = [[200, 0, 0], [0, 200, 0], [0, 0, 200]]
    expected = PIXELS.copy()
    expected[1, 1] = [60, 117, 23]
    text = PLUS_2D.replace("MET_UCHAR", "MET_UCHAR\nElementNumberOfChannels = 3\nUltrasoundImageType = RGB_COLOR")
    assert np.array_equal(sequences.read_sequence(plus_file(tmp_path, text, colours.tobytes())).images, expected)
    text = (
        "NRRD0004\ntype: unsigned char\ndimension: 4\nsizes: 3 3 2 2\nkinds: vector domain domain list\nendian: little\n"
        "encoding: raw\n\n"
    )
    assert np.array_equal(sequences.read_sequence(plus_file(tmp_path, text, colours.tobytes(), ".nrrd")).images, expected)


def test_pixels_in_a_file_of_their_own(tmp_path):
    (tmp_path / "plus.raw").write_bytes(PIXELS.tobytes())
    read = sequences.read_sequence(plus_file(tmp_path, PLUS_2D.replace("LOCAL", "plus.raw"), b"", ".igs.mhd"))
    assert np.array_equal(read.images, PIXELS)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("1.5e-005 ", "", "Seq_Frame0000_ProbeToTrackerTransform: expected 16 finite numbers, found '1 0 0 0 1"),
        ("1.5e-005", "nan", "Seq_Frame0000_ProbeToTrackerTransform: expected 16 finite numbers, found '1 0 0 nan"),
        ("1.5e-005", "-1.#IND", "Seq_Frame0000_ProbeToTrackerTransform: expected 16 finite numbers"),
        ("= 1 0 0 1.5", "= 0 0 0 1.5", "Seq_Frame0000_ProbeToTrackerTransform: expected an invertible matrix with the last row"),
        ("Status = INVALID\nSeq_Frame0001_T", "Status = OK\nSeq_Frame0001_T", "Seq_Frame0001_ProbeToTrackerTransform: expected"),
        ("Timestamp = 1.6", "Timestamp = NaN", "Seq_Frame0001_Timestamp: expected a finite number, found 'NaN'"),
        ("Seq_Frame0001_Timestamp", "Seq_Frame0002_Timestamp", "Seq_Frame0002_Timestamp: expected frames below 2, their"),
        ("MET_UCHAR", "MET_SHORT", "pixels: expected 24 bytes, found 12, the file has been cut short"),
        ("DimSize = 3 2 2", "DimSize = 3 two 2", "DimSize: expected whole numbers of at least 0, found '3 two 2'"),
        ("DimSize = 3 2 2", "DimSize = 3 2 3", "pixels: expected 18 bytes, found 12, the file has been cut short or damaged"),
        ("DimSize = 3 2 2", "DimSize = 3 2 1", "Seq_Frame0001_ProbeToTrackerTransform: expected frames below 1"),
        ("DimSize = 3 2 2", "DimSize = 3 1 2", "pixels: expected 6 bytes, found more"),
        ("DimSize", "Dimsize", "DimSize: expected a value, found none"),
        ("{orientation}", "AMF", "UltrasoundImageOrientation: expected one of MF, UF, MN, UN, FM, FU, NM, NU, found AMF"),
        ("ObjectType", "UltrasoundImageType = RF_REAL\nObjectType", "UltrasoundImageType: expected BRIGHTNESS or RGB_COLOR, f"),
        ("MET_UCHAR", "MET_OTHER", "ElementType: expected grey levels of 8 or 16 bits, or floating-point ones, found"),
        ("MET_UCHAR", "MET_LONG", "ElementType: expected one of MET_UCHAR, MET_CHAR, MET_USHORT"),
        ("CompressedData = False", "CompressedData = True", "pixels: expected packed data, found damaged ones"),
        ("ElementDataFile = LOCAL", "ElementDataFile = .", "data file: expected LOCAL or the name of a file that is there"),
        ("ObjectType = Image", "just some text", "expected lines of a MetaImage header, 'name = value', found 'just some text'"),
    ],
)  # fmt: skip
def test_a_fault_in_one_line(tmp_path, old, new, line):
    assert old in PLUS_2D
    path = plus_file(tmp_path, PLUS_2D.replace(old, new))
    with pytest.raises(InputError) as fault:
        sequences.read_sequence(path)
    assert str(fault.value).startswith(f"{path}: {line}") and "\n" not in str(fault.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_cut_anywhere_is_refused(frames, tmp_path, suffix):
    whole, cut = tmp_path / f"s{suffix}", tmp_path / f"cut{suffix}"
    sequences.write_sequence(whole, frames)
    data = whole.read_bytes()
    for length in [*range(0, len(data) - 10, 23), len(data) // 2, len(data) - 10]:
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=str(cut)):
            sequences.read_sequence(cut)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damage_is_refused_or_harmless(frames, tmp_path, suffix, rng):
    """Whatever bytes a file is made of, there are frames or there is an InputError."""
    path = tmp_path / f"s{suffix}"
    sequences.write_sequence(path, frames)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    refused = 0
    for _ in range(300):
        damaged = data.copy()
        damaged[rng.integers(0, len(data), rng.integers(1, 4))] = rng.integers(0, 256)
        path.write_bytes(damaged.tobytes())
        try:
            sequences.read_sequence(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 50


def test_what_would_not_be_read_back_is_not_written(frames, tmp_path):
    broken = {"ProbeToTracker": frames.transforms["ProbeToTracker"].copy()}
    broken["ProbeToTracker"][3, 1, 1] = np.inf
    late = np.where(np.arange(5) == 2, np.inf, frames.times_s)
    for changed, line in [
        (
            {"transforms": broken},
            "Seq_Frame0003_ProbeToTrackerTransform: expected an invertible matrix of finite numbers, found '.*inf",
        ),
        ({"times_s": late}, "Seq_Frame0002_Timestamp: expected a finite number or NaN, found an infinite one"),
        ({"images": frames.images[:4]}, r"images: expected 5 x height x width of uint8, found \(4, 6, 9\) of uint8"),
        ({"fields": {"Note": "two\nlines"}}, "Note: expected a text of one line"),
        ({"fields": {"DimSize": "1 1 1"}}, "fields: expected names that the format does not use itself, found 'DimSize'"),
        (
            {"transforms": {"probe": frames.transforms["ProbeToTracker"]}, "valid": {"probe": late > 0}},
            "transforms: expected names such as",
        ),
    ]:
        with pytest.raises(InputError, match=line):
            sequences.write_sequence(tmp_path / "s.igs.mha", Frames(**(vars(frames) | changed)))
    with pytest.raises(InputError, match="expected a name that ends in"):
        sequences.write_sequence(tmp_path / "s.png", frames)
    assert list(tmp_path.iterdir()) == []


def test_the_real_sweep_cut_in_half(real, tmp_path):
    data = (real / "tracked_sweep/SpinePhantomFreehand.igs.mha").read_bytes()
    cut = tmp_path / "cut.igs.mha"
    cut.write_bytes(data[: len(data) // 2])
    with pytest.raises(
        InputError, match=r"cut.igs.mha: pixels: expected 3466024 packed bytes, found \d+, the file has been cut short"
    ):
        sequences.read_sequence(cut)


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none.igs.mha: expected a file, found none"):
        sequences.read_sequence(tmp_path / "none.igs.mha")
