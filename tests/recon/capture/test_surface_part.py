"""Capture folders come back as written, and whatever is wrong with one is said in one line before anything is written."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files, images, surface_part, writer
from recon.capture.manifest import Device
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.patterns import CentreLine, Fringes, Patterns

SIZE, PROJECTOR = (64, 48), (128, 80)
PATTERNS = Patterns(projector_size=PROJECTOR, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=4)))


@pytest.fixture
def optics() -> Calibration:
    camera = Camera(SIZE, np.array([[200.0, 0, 31.5], [0, 200, 23.5], [0, 0, 1]]), np.zeros(5))
    pose = rigid.from_rotation_vector([0, -0.2, 0], [150, 0, 0])
    return Calibration({"cam1": camera, "projector": Camera(PROJECTOR, np.diag([190.0, 190, 1]), np.zeros(5), pose)})


def stack(bits: int = 8) -> np.ndarray:
    """Noise images; they compress badly, like real ones."""
    return np.random.default_rng(0).integers(0, 1 << bits, (PATTERNS.count, 48, 64)).astype(np.uint8 if bits == 8 else np.uint16)


def write(folder: Path, optics: Calibration, bits: int = 8) -> np.ndarray:
    devices = {"cam1": Device(size=SIZE, bits=bits, exposure_s=0.01, gain=1.5), "projector": Device(size=PROJECTOR)}
    writer.write_surface(folder, {"cam1": stack(bits)}, PATTERNS, optics, devices, name="test")
    return stack(bits)


@pytest.fixture
def folder(tmp_path, optics) -> Path:
    write(tmp_path / "capture", optics)
    return tmp_path / "capture"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_a_capture_comes_back(tmp_path, optics, bits):
    images = write(tmp_path / "capture", optics, bits)
    found = surface_part.read_surface(tmp_path / "capture")
    assert np.array_equal(found.images, images) and found.images.dtype == images.dtype
    assert found.patterns == PATTERNS and found.bits == bits and found.name == "test"
    assert np.array_equal(found.calibration.cameras["projector"].camera_from_world, optics.cameras["projector"].camera_from_world)


def test_the_same_capture_is_the_same_bytes(tmp_path, optics):
    for name in ("a", "b"):
        write(tmp_path / name, optics)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert sorted(contents(tmp_path / "a"))[:3] == [".sonotwin.json", "calibration/optics.yaml", "manifest.json"]


def test_an_older_capture_is_replaced_and_nothing_is_left_beside(folder, optics):
    """But for what others put into it."""
    (folder / "old.txt").write_text("of somebody")
    write(folder, optics)
    assert contents(folder)["old.txt"] == b"of somebody" and [path.name for path in folder.parent.iterdir()] == ["capture"]


def test_a_folder_of_something_else_is_not_touched(tmp_path, optics):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("mine")
    with pytest.raises(InputError, match=r"thesis: expected .* found other files"):
        write(tmp_path / "thesis", optics)
    assert contents(tmp_path) == {"thesis/chapter1.tex": b"mine"}


def test_a_failed_write_leaves_nothing(tmp_path, optics, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "write_images", fail)
    with pytest.raises(OSError, match="No space"):
        write(tmp_path / "capture", optics)
    assert list(tmp_path.iterdir()) == []


def test_an_image_that_cannot_be_encoded_is_no_capture(tmp_path, optics, monkeypatch):
    """OpenCV says so in a flag."""
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, np.zeros(0, np.uint8)))
    with pytest.raises(OSError, match=r"0\.png: the PNG encoder failed"):
        write(tmp_path / "capture", optics)
    assert list(tmp_path.iterdir()) == []


def edit(folder: Path, change) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def image(folder: Path) -> Path:
    return folder / "surface" / "cam1" / "0002.png"


def rewrite(folder: Path, pixels: np.ndarray) -> None:
    cv2.imwrite(str(image(folder)), pixels)


AN_IMAGE = "expected an image (.png, .bmp, .tif, .tiff, .jpg, .jpeg)"
FAULTS = {
    "no manifest": (
        lambda f: (f / "manifest.json").unlink(),
        "manifest.json: expected a file, found none; `sonotwin describe` makes",
    ),
    "no folder": (shutil.rmtree, ": expected a capture, found no such folder"),
    "no JSON": (lambda f: (f / "manifest.json").write_text("{"), "manifest.json: expected JSON, found "),
    "newer": (
        lambda f: edit(f, lambda m: m.update(schema="sonotwin-capture/2")),
        "manifest.json: schema: expected 'sonotwin-capture/1', found 'sonotwin-capture/2'",
    ),
    "no version": (lambda f: edit(f, lambda m: m.pop("schema")), "manifest.json: schema: expected a value, found none"),
    "unknown key": (lambda f: edit(f, lambda m: m.update(sizes=3)), "manifest.json: sizes: expected no such field, found 3"),
    "NaN": (
        lambda f: edit(f, lambda m: m["devices"]["cam1"].update(exposure_s=float("nan"))),
        "manifest.json: expected finite numbers, found NaN",
    ),
    "size as text": (
        lambda f: edit(f, lambda m: m["devices"]["cam1"].update(size=["a", 2])),
        "manifest.json: devices.cam1.size.0: expected integer",
    ),
    "9 bits": (
        lambda f: edit(f, lambda m: m["devices"]["cam1"].update(bits=9)),
        "manifest.json: devices.cam1.bits: expected 8, 10 or 12, found 9",
    ),
    "an image short": (
        lambda f: edit(f, lambda m: m["surface"]["images"]["cam1"].pop()),
        "manifest.json: surface.images.cam1: expected 5 images, one a pattern, found 4",
    ),
    "unknown camera": (
        lambda f: edit(f, lambda m: m["devices"].pop("cam1")),
        "manifest.json: surface.images.cam1: expected one of the devices projector, found cam1",
    ),
    "no surface": (
        lambda f: edit(f, lambda m: m.pop("surface")),
        "manifest.json: expected surface images of cam1, found no surface part",
    ),
    "no calibration": (
        lambda f: edit(f, lambda m: m.pop("calibration")),
        "manifest.json: expected calibration, the path of a calibration file, found none",
    ),
    "lost calibration": (
        lambda f: (f / "calibration" / "optics.yaml").unlink(),
        "optics.yaml: expected a calibration file, found none",
    ),
    "nested": (
        lambda f: (f / "manifest.json").write_text("[" * 100_000),
        "manifest.json: expected JSON, found values nested too deeply",
    ),
    "tiny": (
        lambda f: edit(f, lambda m: m["devices"]["cam1"].update(size=[64, 4])),
        "manifest.json: devices.cam1.size.1: expected greater than or equal to 8, found 4",
    ),
    "two sizes of projector": (
        lambda f: edit(f, lambda m: m["devices"]["projector"].update(size=[1280, 800])),
        "manifest.json: devices.projector.size: expected 128x80 as in surface.patterns, found 1280x800",
    ),
    "other projector": (
        lambda f: edit(f, lambda m: (m["devices"].pop("projector"), m["surface"]["patterns"].update(projector_size=[1280, 800]))),
        "optics.yaml: expected projector of 1280x800 px, found 128x80",
    ),
    "other camera": (
        lambda f: edit(f, lambda m: m["devices"]["cam1"].update(size=[80, 60])),
        "optics.yaml: expected cam1 of 80x60 px, found 64x48",
    ),
    "missing image": (lambda f: image(f).unlink(), "0002.png: expected a file, found none"),
    "empty image": (lambda f: image(f).write_bytes(b""), f"0002.png: {AN_IMAGE}, found an empty file"),
    "no image": (lambda f: image(f).write_bytes(b"hello"), f"0002.png: {AN_IMAGE}, found other or damaged data"),
    "folder": (lambda f: (image(f).unlink(), image(f).mkdir()), "0002.png: expected a file, found a folder"),
    "size": (lambda f: rewrite(f, np.zeros((40, 64), np.uint8)), "0002.png: expected 64x48 8-bit, found 64x40 8-bit"),
    "16 bits": (lambda f: rewrite(f, np.zeros((48, 64), np.uint16)), "0002.png: expected 64x48 8-bit, found 64x48 16-bit"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line_and_changes_nothing(folder, fault):
    spoil, complaint = FAULTS[fault]
    spoil(folder)
    before = contents(folder)
    with pytest.raises(InputError) as refusal:
        surface_part.read_surface(folder)
    message = str(refusal.value)
    assert message.startswith(str(folder)) and complaint in message and "\n" not in message
    assert contents(folder) == before


def test_an_image_cut_anywhere_is_refused(folder):
    """At every 23rd byte and just before its end; what OpenCV makes of it depends on its version."""
    whole = image(folder).read_bytes()
    for length in [*range(1, len(whole), 23), len(whole) - 1]:
        image(folder).write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"0002.png: expected .* found"):
            surface_part.read_surface(folder)


def test_a_flipped_bit_is_refused(folder):
    data = bytearray(image(folder).read_bytes())
    data[len(data) // 2] ^= 4
    image(folder).write_bytes(data)
    with pytest.raises(InputError, match=r"0002.png: expected a whole PNG image, found damaged data at byte"):
        surface_part.read_surface(folder)


def test_left_aligned_values_are_refused(tmp_path, optics):
    """10 bits in the upper end of 16 would look like saturation."""
    write(tmp_path / "capture", optics, 10)
    rewrite(tmp_path / "capture", np.full((48, 64), 1023 << 6, np.uint16))
    with pytest.raises(InputError, match=r"0002.png: expected 10-bit values up to 1023, right-aligned, found 65472"):
        surface_part.read_surface(tmp_path / "capture")


@pytest.fixture
def bare(tmp_path, optics) -> tuple[Path, Path, Path]:
    """A folder of images numbered without zeros, a patterns file and a calibration file."""
    (tmp_path / "shots").mkdir()
    for i, picture in enumerate(stack()):
        cv2.imwrite(str(tmp_path / "shots" / f"shot{i + 7}.png"), picture)
    (tmp_path / "shots" / "notes.txt").write_text("not an image")
    (tmp_path / "patterns.yaml").write_text(PATTERNS.model_dump_json())  # JSON is YAML
    calibration_files.write(tmp_path / "optics.yaml", optics)
    return tmp_path / "shots", surface_part.read_patterns(tmp_path / "patterns.yaml"), tmp_path / "optics.yaml"


def test_a_bare_folder_is_read_in_natural_order(bare):
    found = surface_part.read_bare(*bare)
    assert np.array_equal(found.images, stack()) and found.bits == 8 and found.name == "shots"


@pytest.mark.parametrize("kind", ["bmp", "tiff"])
def test_a_bare_folder_of_another_kind_in_colour(bare, kind):
    """As a colour camera or its software saves them."""
    for path in bare[0].glob("*.png"):
        cv2.imwrite(str(path.with_suffix(f".{kind}")), cv2.imread(str(path), cv2.IMREAD_COLOR))
        path.unlink()
    assert np.array_equal(surface_part.read_bare(*bare).images, stack())


@pytest.mark.parametrize("root", ["relative", "absolute"])
def test_a_manifest_wraps_images_from_elsewhere(folder, bare, tmp_path, root):
    shots = sorted(bare[0].glob("*.png"), key=images.natural_key)

    def wrap(manifest):
        manifest["root"] = str(bare[0]) if root == "absolute" else "../shots"
        manifest["surface"]["images"]["cam1"] = [path.name for path in shots]

    edit(folder, wrap)
    for path in (folder / "surface" / "cam1").iterdir():
        path.unlink()
    assert np.array_equal(surface_part.read_surface(folder).images, stack())


def test_faults_of_a_bare_folder(bare):
    images, patterns, optics = bare
    with pytest.raises(InputError, match="nowhere: expected a folder of images, found nothing"):
        surface_part.read_bare(images.with_name("nowhere"), patterns, optics)
    for content, complaint in {
        "parts: [": "expected YAML",
        "[" * 10_000: "expected YAML, found values nested too deeply",
        "parts: []": "projector_size: expected a value, found none",
        "projector_size: [.nan, 2]\nunwrap: gray\nparts: []": r"projector_size.0: expected a finite number",
    }.items():
        (bad := optics.with_name("bad.yaml")).write_text(content)
        with pytest.raises(InputError, match=f"bad.yaml: {complaint}"):
            surface_part.read_patterns(bad)
    (images / "shot7.png").unlink()
    with pytest.raises(InputError, match="shots: expected 5 images, one a pattern, found 4"):
        surface_part.read_bare(images, patterns, optics)
