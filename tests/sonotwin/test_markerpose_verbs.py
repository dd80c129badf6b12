"""MarkerPose's layouts by the commands: training data out, frames of its example out and in, networks by the scripts' names."""
# ruff: noqa: E402 - torch is asked for before what needs it

import io
import shutil
import tarfile

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from recon.capture import calibration_files, stereo_frames
from recon.capture.manifest import CAMERAS, Device
from recon.capture.writer import new_capture
from sonotwin.cli import main
from tests.recon.tracking import films
from tests.sonotwin.test_meza2021_verbs import COUNT, SIZE, contents, noise, optics
from tests.trainers.conftest import write_set
from trainers import architectures, export
from trainers.network_metrics import decode
from trainers.shard_reader import PATCH, VIEW

STATE = {"published_detector": "detector.pt", "published_segmenter": "segmenter.pt"}


@pytest.fixture
def film(tmp_path):
    """Frames of both cameras alone, 10 bits of which go out as 8."""
    times = (1e9 * np.arange(COUNT)).astype(np.int64)
    images = [(camera, image.astype(np.uint16) << 2) for k, camera in enumerate(CAMERAS) for image in noise(COUNT, SIZE, k)]
    with new_capture(tmp_path / "film", "rig") as made:
        made.add_calibration(optics())
        made.add_sweep(dict.fromkeys(CAMERAS, times), images, {camera: Device(size=SIZE, bits=10) for camera in CAMERAS})
    return tmp_path / "film"


@pytest.fixture
def networks(tmp_path):
    """Fresh weights of the published shape."""
    folder = tmp_path / "published"
    folder.mkdir()
    for name, file in STATE.items():
        export.save(folder / file, architectures.network(name, circles=3))
    return folder


def test_the_example_goes_out_and_comes_back(film, networks, tmp_path):
    theirs = tmp_path / "theirs"
    assert main(["export", "layout=markerpose", f"capture={film}", f"networks={networks}", f"out={theirs}"]) == 0
    for name, file in zip(STATE, ("py_superpoint.pt", "py_ellipsegnet.pt"), strict=True):
        architectures.network(name, circles=3).load_state_dict(torch.load(theirs / file, weights_only=True), strict=True)
    assert main(["import", "layout=markerpose", f"folder={theirs}", f"out={tmp_path / 'back'}"]) == 0
    back = stereo_frames.read_film(tmp_path / "back")
    for k, pair in enumerate(back.pairs()):
        assert np.array_equal(pair[0], noise(COUNT, SIZE, 0)[k]) and np.array_equal(pair[1], noise(COUNT, SIZE, 1)[k])
    found = calibration_files.of_capture(tmp_path / "back").cameras["cam2"]
    assert found.camera_from_world == pytest.approx(optics().cameras["cam2"].camera_from_world)


def test_a_data_set_goes_out_for_their_training_and_trains_here(tmp_path, capsys):
    write_set(tmp_path / "data", 12)
    theirs = tmp_path / "theirs"
    assert main(["export", "layout=markerpose", f"data={tmp_path / 'data'}", f"out={theirs}"]) == 0
    assert "of 24, those with all circles" in capsys.readouterr().out
    assert {name.partition("/")[0] for name in contents(theirs)} == {
        "data_centers.csv", "images", "patch120", "mask120", ".sonotwin.json",
    }  # fmt: skip
    line = ["train", "network=detector", f"data={theirs}", "steps=2", "batch=2", "crop_px=64", "threads=1"]
    assert main([*line, f"out={tmp_path / 'net'}"]) == 0
    (theirs / "images" / "im3.png").unlink()
    assert main([*line, f"out={tmp_path / 'other'}"]) == 2 and not (tmp_path / "other").exists()
    assert "im3.png: expected a file, found none" in capsys.readouterr().err


def test_patches_go_out_of_those_sets_that_have_them(tmp_path, capsys):
    """Full frames have none, beside views that have."""
    write_set(tmp_path / "data", 6)
    write_set(tmp_path / "bare", 6, seed=1)
    shard = tmp_path / "bare" / "shard-00000.tar"
    with tarfile.open(shard) as archive:
        kept = [(entry, archive.extractfile(entry).read()) for entry in archive if "patches" not in entry.name]
    with tarfile.open(shard, "w") as archive:
        for entry, content in kept:
            archive.addfile(entry, io.BytesIO(content))
    line = ["export", "layout=markerpose", f"data=[{tmp_path / 'bare'},{tmp_path / 'data'}]", f"out={tmp_path / 'theirs'}"]
    assert main(line) == 0
    said = capsys.readouterr().out
    assert "of 36, those with a disc" in said and f"left out    patches: {tmp_path / 'bare'} has none" in said
    assert "of 24, those with all circles" in said


def test_networks_go_out_with_the_data_set_of_the_rig(film, networks, tmp_path):
    """By the names that ProbePose.py loads."""
    with new_capture(tmp_path / "capture", "rig") as made:
        made.add_calibration(optics())
    assert main(["export", f"capture={tmp_path / 'capture'}", f"networks={networks}", f"out={tmp_path / 'theirs'}"]) == 0
    assert {"superpoint.pt", "ellipsegnet.pt"} <= contents(tmp_path / "theirs").keys()


@pytest.mark.parametrize(("fields", "complaint"), [
    ([], "export: data: needs a value with layout=markerpose"),
    (["capture={film}", "lag_s=0.1"], "export: lag_s: expected none with layout=markerpose"),
    (["networks={networks}", "sweep=scan"], "export: sweep: expected none without capture, found scan"),
    (["data={folder}/none"], "none: expected a folder with shards"),
    (["networks={folder}"], "networks: expected detector.pt in one folder of"),
    (["networks={networks}"], "detector.pt: expected weights conv1.double_conv.0.weight of shape [64, 1, 3, 3], found none; "
     "sonotwin train network=published_detector makes the published shape"),
])  # fmt: skip
def test_what_cannot_go_out_is_one_line(film, networks, tmp_path, capsys, fields, complaint):
    export.save(networks / "detector.pt", architectures.network("detector", circles=3))
    fields = [field.format(film=film, folder=tmp_path, networks=networks) for field in fields]
    assert main(["export", "layout=markerpose", *fields, f"out={tmp_path / 'theirs'}"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert complaint in said[-1] and said[-1].startswith("sonotwin: ") and not (tmp_path / "theirs").exists()


@pytest.mark.parametrize(("spoil", "complaint"), [
    (lambda folder: shutil.rmtree(folder / "images" / "R"), "images: expected L and R with images, as of MarkerPose, found L"),
    (lambda folder: (folder / "images" / "L" / "2.png").unlink(), "R: expected 5 frames, as in L/, found 6"),
    (lambda folder: (folder / "StereoParams.xml").unlink(), "StereoParams.xml: expected"),
    (lambda folder: (folder / "images" / "L" / "2.png").write_bytes(b"none"), "2.png: expected an image"),
])  # fmt: skip
def test_bad_examples_are_one_line(film, tmp_path, capsys, spoil, complaint):
    theirs = tmp_path / "theirs"
    assert main(["export", "layout=markerpose", f"capture={film}", f"out={theirs}"]) == 0
    spoil(theirs)
    assert main(["import", "layout=markerpose", f"folder={theirs}", f"out={tmp_path / 'back'}"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert complaint in said[-1] and said[-1].startswith("sonotwin: ") and not (tmp_path / "back").exists()


def test_shipped_networks_find_the_target(rig, tmp_path):
    """In drawn frames, as none that they were trained with: places to 3 px of the view, which circle is c2, and middles of masks.

    c0 and c1 are told by their turn about c2 in the published program.
    """
    with new_capture(tmp_path / "capture", "rig") as made:
        made.add_calibration(optics())
    assert main(["export", f"capture={tmp_path / 'capture'}", "networks=shipped", f"out={tmp_path / 'theirs'}"]) == 0
    detector, segmenter = (architectures.network(name, circles=3) for name in STATE)
    for network, file in ((detector, "superpoint.pt"), (segmenter, "ellipsegnet.pt")):
        network.load_state_dict(torch.load(tmp_path / "theirs" / file, weights_only=True), strict=True)
        network.eval()
    poses = films.places(COUNT)
    for pose, frames in zip(poses, films.draw(rig, poses, np.random.default_rng(4)), strict=True):
        for frame, centres in zip(frames, films.centres(rig, pose), strict=True):
            view = torch.from_numpy(cv2.resize(frame, VIEW).astype(np.float32) / 255)
            patches = [cv2.getRectSubPix(frame, (PATCH, PATCH), tuple(centre)) for centre in centres.tolist()]
            with torch.no_grad():
                found = decode(*detector(view[None, None]), most=3)[0]
                masks = segmenter(torch.from_numpy(np.float32(patches) / 255)[:, None])[:, 0].numpy() > 0
            expected = centres / np.array(frame.shape[::-1]) * VIEW
            nearest = np.linalg.norm(found.places[:, None] - expected, axis=-1)
            assert sorted(nearest.argmin(axis=1)) == [0, 1, 2] and nearest.min(axis=1).max() < 3
            assert found.identities[nearest[:, 2].argmin()] == 2
            middles = np.array([np.argwhere(mask).mean(axis=0) for mask in masks])
            assert np.abs(middles - (PATCH - 1) / 2).max() < 0.5
