"""The rig authors' layout is written so that their formulas decode it, and read back as it was."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files
from recon.capture.layouts import meza2021
from recon.capture.surface_part import SurfaceCapture
from recon.errors import InputError
from recon.files import atomic
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration


@pytest.fixture
def surface() -> SurfaceCapture:
    """The projector's own columns as the camera's, so that truth is the pixel's number."""
    matrix = np.array([[1500.0, 0, 600], [0, 1500, 10], [0, 0, 1]])
    pose = rigid.from_rotation_vector([0, -0.2, 0.01], [150, 3, 20])
    optics = Calibration(
        {"cam1": Camera((1280, 24), matrix, np.zeros(5)), "projector": Camera((1280, 800), matrix, np.full(5, 0.01), pose)}
    )
    images = np.round(20 + 200 * meza2021.patterns().images()[:, :24]).astype(np.uint8)
    return SurfaceCapture(images, meza2021.patterns(), 8, optics, "rig")


def write(folder, surface, mask) -> None:
    with atomic.new_folder(folder, "export") as temporary:
        meza2021.write(temporary, surface, mask)


def test_it_comes_back(surface, tmp_path):
    mask = np.random.default_rng(0).random((24, 1280)) > 0.5
    write(tmp_path / "rig", surface, mask)
    found, found_mask = meza2021.read(tmp_path / "rig")
    assert np.array_equal(found.images, surface.images) and np.array_equal(found_mask, mask)
    assert found.patterns == surface.patterns and found.name == "rig"
    for name, camera in surface.calibration.cameras.items():
        assert found.calibration.cameras[name].size == camera.size
        assert np.allclose(found.calibration.cameras[name].camera_from_world, camera.camera_from_world, atol=1e-12)
        assert np.array_equal(found.calibration.cameras[name].distortion, camera.distortion)


def test_their_formula_finds_the_column(surface):
    """phase = -atan2(sum I sin, sum I cos) for shifts 2 pi k / 8, k = 1 to 8; x = 12 phase / 2 pi + 639.5."""
    fringes, shifts = surface.images[1:9].astype(float), 2 * np.pi * np.arange(1, 9) / 8
    phase = -np.arctan2(np.tensordot(np.sin(shifts), fringes, 1), np.tensordot(np.cos(shifts), fringes, 1))
    difference = 12 / (2 * np.pi) * phase + (1280 - 1) / 2 - np.arange(1280)
    assert np.abs(difference - 12 * np.round(difference / 12)).max() < 0.01, "rounding to whole digital numbers"


def test_images_between_are_left_out_and_order_is_natural(surface, tmp_path):
    """Their folders hold further images between the fringes and the fully lit one, without a mask."""
    write(tmp_path / "rig", surface, np.ones((24, 1280), bool))
    images = tmp_path / "rig" / "SLdata" / "images"
    (images / "9.png").rename(images / "12.png")
    for extra in (9, 10, 11):
        (images / f"{extra}.png").write_bytes((images / "0.png").read_bytes())
    (tmp_path / "rig" / "SLdata" / "mask.png").unlink()
    found, mask = meza2021.read(tmp_path / "rig")
    assert np.array_equal(found.images, surface.images) and mask.all()


def test_missing_images_are_named(surface, tmp_path):
    write(tmp_path / "rig", surface, np.ones((24, 1280), bool))
    for number in (3, 4):
        (tmp_path / "rig" / "SLdata" / "images" / f"{number}.png").unlink()
    with pytest.raises(InputError, match="images: expected at least 9 images, found 8"):
        meza2021.read(tmp_path / "rig")


def test_the_lit_image_may_be_missing(surface, tmp_path):
    """Nine images are the centre line and the fringes."""
    write(tmp_path / "rig", surface, np.ones((24, 1280), bool))
    (tmp_path / "rig" / "SLdata" / "images" / "9.png").unlink()
    found, _ = meza2021.read(tmp_path / "rig")
    assert found.patterns == meza2021.patterns(lit=False) and np.array_equal(found.images, surface.images[:9])
    assert meza2021.is_theirs(found)


@pytest.mark.parametrize(("suffix", "off"), [(".bmp", 0), (".tiff", 0), (".jpg", 6)])
def test_other_kinds_of_images_count_in_colour_too(surface, tmp_path, suffix, off):
    """JPEG is not exact."""
    write(tmp_path / "rig", surface, np.ones((24, 1280), bool))
    for path in (tmp_path / "rig" / "SLdata" / "images").iterdir():
        cv2.imwrite(str(path.with_suffix(suffix)), cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2BGR))
        path.unlink()
    found, _ = meza2021.read(tmp_path / "rig")
    assert np.abs(found.images.astype(int) - surface.images).max() <= off


def test_a_mask_that_cannot_be_written_leaves_nothing(surface, tmp_path, monkeypatch):
    encode = cv2.imencode

    def all_but_masks(suffix, image, *options):
        return (False, None) if set(np.unique(image)) <= {0, 255} else encode(suffix, image, *options)

    monkeypatch.setattr(cv2, "imencode", all_but_masks)
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    with pytest.raises(OSError, match=r"mask.png: the PNG encoder failed"):
        write(tmp_path / "rig", surface, np.ones((24, 1280), bool))
    assert not list(tmp_path.iterdir())


def test_other_patterns_are_not_theirs(surface, tmp_path):
    other = SurfaceCapture(surface.images, surface.patterns, 10, surface.calibration, "rig")
    with pytest.raises(ValueError, match="8-bit capture of the authors' patterns"):
        meza2021.write(tmp_path, other, np.ones((24, 1280), bool))
    assert not list(tmp_path.iterdir())


def test_the_files_of_pairs_come_back(surface, tmp_path):
    """Each file alone gives its pair of devices; the XML is what the npz is."""
    cameras = dict(surface.calibration.cameras)
    cameras["cam2"] = Camera(
        (1280, 24), cameras["cam1"].matrix, np.full(8, 0.02), rigid.from_rotation_vector([0, 0.3, 0], [-9, 1, 2])
    )
    written = meza2021.write_parameters(tmp_path, Calibration(cameras))
    assert sorted(written) == sorted(path.name for path in tmp_path.iterdir())
    sizes = {name: camera.size for name, camera in cameras.items()}
    for file, second in (("cam1_proj_params.npz", "projector"), ("cam1_cam2_params.npz", "cam2"), ("StereoParams.xml", "cam2")):
        found = calibration_files.read(tmp_path / file, sizes).cameras
        assert list(found) == ["cam1", second]
        for name, camera in found.items():
            assert np.allclose(camera.matrix, cameras[name].matrix, atol=1e-12)
            assert np.allclose(camera.distortion, cameras[name].distortion, atol=1e-12)
            assert np.allclose(camera.camera_from_world, cameras[name].camera_from_world, atol=1e-12)
    storage = cv2.FileStorage(str(tmp_path / "StereoParams.xml"), cv2.FileStorage_READ)
    with np.load(tmp_path / "cam1_cam2_params.npz") as pair:
        assert sorted(pair) == ["F", "K1", "K2", "R", "dist1", "dist2", "t"]
        assert all(np.allclose(storage.getNode(name).mat(), pair[name], rtol=1e-12) for name in pair)


def test_lenses_without_distortion_come_back(surface, tmp_path):
    """OpenCV reads no empty matrix from its own files."""
    ideal = {name: replace(camera, distortion=np.zeros(0)) for name, camera in surface.calibration.cameras.items()}
    ideal["cam2"] = replace(ideal["projector"], size=(1280, 24))
    for file in meza2021.write_parameters(tmp_path, Calibration(ideal)):
        found = calibration_files.read(tmp_path / file, {name: camera.size for name, camera in ideal.items()}).cameras
        assert all(not camera.distortion.any() for camera in found.values()), file


def test_a_rig_without_second_camera_has_one_pair(surface, tmp_path):
    assert meza2021.write_parameters(tmp_path, surface.calibration) == ["cam1_proj_params.npz"]
    assert [path.name for path in tmp_path.iterdir()] == ["cam1_proj_params.npz"]
