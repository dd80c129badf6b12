"""A rendered session: what is in the folders, and that the same seed gives the same bytes."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from recon.capture import calibration_files, surface_part, writer
from recon.capture.manifest import Device
from recon.errors import InputError
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.patterns import Fringes
from recon.structured_light.phase import Noise, wrapped_phase
from scenes.catalogue import build_scene
from tests.twin.small_rigs import shrunk
from twin.experiments.optics_accuracy import paper_surface
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render
from twin.optics.raster import Light
from twin.optics.ray_world import build_world
from twin.optics.surface_session import Shooting, noise_limit_px, shoot, write_session
from twin.sensor import Exposure, auto_exposure, expose
from twin.session import Session, TruthFolder


@pytest.fixture(scope="module")
def small_rig(rig):
    """The rig with images of a quarter of the size."""
    return rig.model_copy(update={"cam1": shrunk(rig.cam1, 4)})


@pytest.fixture(scope="module")
def session(small_rig, tmp_path_factory) -> Path:
    return write(small_rig, tmp_path_factory.mktemp("session"), seed=4)


def write(rig, out: Path, seed: int, add: bool = False) -> Path:
    scene, patterns = build_scene({"kind": "sphere"}), paper_surface((1280, 800))
    view = shoot(rig, scene, patterns, "cam1", Tracing(samples=4), Shooting(), seed)
    write_session(Session(out, "surface", {"seed": seed}, add), rig, rig, scene, patterns, {"cam1": view})
    return out


def digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_pipeline_reads_it(session, small_rig):
    """The capture passes the reader's checks, with the patterns and the calibration of the rig."""
    read = surface_part.read_surface(session / "capture")
    assert read.images.shape == (9, 256, 320)
    assert read.patterns == paper_surface((1280, 800))
    np.testing.assert_allclose(read.calibration.cameras["cam1"].matrix, small_rig.cam1.optics.camera().matrix)


def test_a_measured_calibration_stays_when_a_surface_is_added(session, small_rig, tmp_path):
    """Somebody has measured the cameras of a capture that holds another part; the twin adds its own where there is none."""
    with Session(tmp_path, "sweep", {}, devices=("us",)).write({"name": "scans"}) as (capture, _):
        capture.add_sweep({"us": np.arange(1)}, [("us", np.zeros((48, 64), np.uint8))], {"us": Device(size=(64, 48))})
    path = tmp_path / "capture" / "calibration" / "optics.yaml"
    path.parent.mkdir()
    measured = Camera((320, 256), np.diag([801.0, 802, 1]), np.zeros(5))
    calibration_files.write(path, Calibration({"cam1": measured}))
    write(small_rig, tmp_path, seed=4, add=True)
    found = surface_part.read_surface(tmp_path / "capture").calibration
    assert np.array_equal(found.cameras["cam1"].matrix, measured.matrix) and "projector" in found.cameras
    true = TruthFolder(tmp_path / "truth", "surface").optics("cam1")["cam1"]
    np.testing.assert_allclose(true.matrix, small_rig.cam1.optics.camera().matrix)


def test_truth_lies_beside(session, small_rig):
    """Truth has the camera's size, the scene's shapes, the true calibration."""
    truth = np.load(session / "truth" / "surface" / "cam1.npz")
    assert truth["points"].shape == (256, 320, 3)
    assert truth["lit"].mean() > 0.5
    described = json.loads((session / "truth" / "scene.json").read_text())
    assert "sphere" in [shape["kind"] for shape in described["shapes"]]
    true = calibration_files.read(session / "truth" / "calibration" / "optics.yaml")
    np.testing.assert_allclose(true.cameras["projector"].centre, small_rig.projector.optics.camera().centre, atol=1e-6)


def test_same_seed_same_bytes(session, small_rig, tmp_path):
    """Every file is the same when rendered again with the same seed; the images differ with another."""
    assert digest(write(small_rig, tmp_path / "again", seed=4)) == digest(session)
    other = digest(write(small_rig, tmp_path / "other", seed=5))
    assert other["capture/surface/cam1/0003.png"] != digest(session)["capture/surface/cam1/0003.png"]


def test_a_lens_that_leaves_pixels_dark_is_refused(small_rig):
    """A fold of the distortion within the image has no rays beyond it: said by name, not a NaN in the end."""
    optics = small_rig.cam1.optics.model_copy(update={"focal_px": (200.0, 200.0), "distortion": (-0.35, 0.0, 0.0, 0.0)})
    rig = small_rig.model_copy(update={"cam1": small_rig.cam1.model_copy(update={"optics": optics})})
    with pytest.raises(InputError, match=r"rig.cam1.optics.distortion: expected a ray for every pixel, found \d+ px"):
        shoot(rig, build_scene({"kind": "plane"}), paper_surface((1280, 800)), "cam1", Tracing(samples=2), Shooting(), 1)


def test_a_killed_session_does_not_mix_with_an_old_one(small_rig, tmp_path, monkeypatch):
    """If writing stops after the new truth, the old capture stands beside the old truth."""
    write(small_rig, tmp_path, seed=1)
    before = digest(tmp_path)
    monkeypatch.setattr(writer, "write_images", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write(small_rig, tmp_path, seed=2)
    assert digest(tmp_path) == before


def test_noise_limit_is_the_noise(small_rig):
    """The phase of repeated exposures scatters as `limit_px` says (3 %)."""
    scene, patterns = build_scene({"kind": "plane"}), paper_surface((1280, 800))
    fringes = patterns.parts[1]
    assert isinstance(fringes, Fringes)
    light_seed = 1  # one rendering, many exposures
    device, wavelength = small_rig.cam1, small_rig.projector.wavelength_nm
    radiance = render(
        build_world(scene), CameraOptics.of(device), ProjectorOptics.of(small_rig.projector),
        Light.of(patterns, small_rig.projector), Tracing(samples=4), light_seed,
    )  # fmt: skip
    exposure = Exposure(auto_exposure(radiance, device, wavelength))
    limits = noise_limit_px(radiance, patterns, device, wavelength, exposure)
    assert np.isinf(limits[..., 1]).all()  # no fringes along the rows
    limit = limits[..., 0]
    phases = []
    for seed in range(16):
        images = expose(radiance[1:], device, wavelength, exposure, seed)
        phases.append(wrapped_phase(images, fringes.shifts, noise=Noise(0, 0), saturation=255).phase)
    spread = np.angle(np.exp(1j * (np.array(phases) - phases[0])))
    deviation = (spread - spread.mean(axis=0)) * fringes.pitch / (2 * np.pi)
    bright = limit < 0.1
    measured = np.sqrt((deviation[:, bright] ** 2).sum(axis=0).mean() / 15)
    assert bright.mean() > 0.8
    assert measured == pytest.approx(np.sqrt((limit[bright] ** 2).mean()), rel=0.03)
