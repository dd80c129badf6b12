"""A capture and its truth are of one rendering, whenever it stops; a part takes the place of an earlier one of its kind alone."""

import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.capture import manifest
from recon.capture.images import read_image
from recon.capture.manifest import CAMERAS, SCANNER, SCHEMA, BoardPart, Device, Manifest, SweepPart, is_sweep
from recon.capture.writer import CaptureWriter, write_pose
from recon.errors import InputError
from recon.files import written_files
from recon.files.npz import Form
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.patterns import CentreLine, Fringes, Patterns
from scenes.scene_types import Scene, Sphere
from twin.session import SCENE, SETTINGS, Session, TruthFolder, describe

SIZE, PROJECTOR = (64, 48), (128, 80)
PATTERNS = Patterns(projector_size=PROJECTOR, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=4)))
KINDS = [
    ("surface", ()),
    ("board", ()),
    ("sweep", (SCANNER,)),
    ("sweep", CAMERAS),
]


def noise(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *SIZE[::-1]), np.uint8)


def optics(*names: str) -> Calibration:
    return Calibration({name: Camera(SIZE, np.diag([200.0, 200, 1]), np.zeros(5)) for name in names})


def scene(name: str) -> Scene:
    return Scene(name, (), (Sphere("ball", np.array([0.0, 0.0, 650.0]), 20.0),))


def render(
    out: Path, part: str, seed: int, add: bool = False, rig: object = "ours", devices: tuple[str, ...] = (SCANNER,)
) -> None:
    """Write a part whose capture and truth hold the seed."""
    session = Session(out, part, {"rig": rig, "seed": seed}, add, devices if is_sweep(part) else ())
    with session.write(describe(scene(part), things=["ball"])) as (capture, truth):
        camera = Device(size=SIZE, exposure_s=0.01 * seed)
        truth.write_optics(optics("cam1", "projector"))
        if part == "surface":
            truth.write_arrays("surface/cam1.npz", {"seed": np.array(seed)})
            capture.add_surface({"cam1": noise(PATTERNS.count, seed)}, PATTERNS, {"cam1": camera})
        elif part == "board":
            truth.write_arrays("board.npz", {"seed": np.array(seed)})
            design = AsymmetricCircles(columns=4, rows=11, spacing_mm=15.0, diameter_mm=9.0)
            pose = write_pose(capture.folder, "00", {"cam1": noise(1, seed)[0]}, {})
            capture.add_board(BoardPart(board=design, poses=(pose,)), {"cam1": camera})
        else:
            truth.write_arrays(f"{part}/sweep.npz", {"seed": np.array(seed)})
            times = dict.fromkeys(devices, np.arange(1, 3))
            images = ((device, image) for device in devices for image in noise(2, seed))
            capture.add_sweep(times, images, dict.fromkeys(devices, camera), name=part.partition("/")[2])


IMAGES = {"surface": "surface/cam1/0000.png", "board": "board/00/cam1/lit.png", "sweep": "sweep/us/0000.png"}
ARRAYS = {"surface": "surface/cam1.npz", "board": "board.npz", "sweep": "sweep/sweep.npz"}


def seeds(out: Path) -> dict[str, int]:
    """The seed of each part that is there; its image, arrays, settings and exposure are all of one."""
    found = {}
    read = manifest.read_manifest(out / "capture")
    for part, held in read.contents.items():
        truth = TruthFolder(out / "truth", part)
        seed = truth.settings()["seed"]
        arrays = ARRAYS.get(part, f"{part}/sweep.npz")
        assert int(truth.arrays(arrays, {"seed": Form("fiu", ())})["seed"]) == seed
        assert truth.scene()["name"] == part
        assert read.devices_of(part)[held[0]].exposure_s == 0.01 * seed
        image = read_image(out / "capture" / IMAGES.get(part, f"{part}/us/0000.png"), SIZE, 8)
        assert np.array_equal(image, noise(1 if part == "board" else 2, seed)[0] if part != "surface" else noise(5, seed)[0])
        found[part] = seed
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(("devices", "label"), [((SCANNER,), "sweep of us"), (CAMERAS, "sweep of cam1 and cam2")])
def test_only_the_same_kind_is_replaced(tmp_path, devices, label):
    """What a sweep is follows from the devices that the manifest lists."""
    (tmp_path / "capture").mkdir()
    part = SweepPart(images={name: f"sweep/{name}" for name in devices})
    content = Manifest(schema=SCHEMA, devices={name: Device(size=SIZE) for name in devices}, sweep=part)
    manifest.write_manifest(tmp_path / "capture", content)
    with pytest.raises(InputError, match="no list of ours"):  # as of a recording
        Session(tmp_path, "sweep", {}, devices=devices).check()
    listed = written_files.written(tmp_path / "capture" / "manifest.json", "the twin")
    written_files.write_list(tmp_path / "capture" / written_files.LIST, {"manifest.json": (listed,)})
    Session(tmp_path, "sweep", {}, devices=devices).check()
    for kind, others in KINDS:
        if (kind, others) == ("sweep", devices):
            continue
        wanted = f"sweep of {' and '.join(others)}" if others else kind
        with pytest.raises(InputError, match=f"expected nothing or an earlier {wanted}, found a {label}; choose another"):
            Session(tmp_path, kind, {}, devices=others).check()
        if kind == "sweep":
            with pytest.raises(InputError, match=f"found a {label}; choose another out$"):
                Session(tmp_path, kind, {}, True, others).check()
        else:
            Session(tmp_path, kind, {}, True, others).check()


@pytest.mark.parametrize("order", [("surface", "board", "sweep"), ("sweep", "surface", "board")])
def test_parts_are_added_and_replaced_one_by_one(tmp_path, order):
    """Each keeps its own settings and truth, whichever came first, and whichever is rendered anew."""
    for seed, part in enumerate(order, 1):
        render(tmp_path, part, seed, add=True)
    assert seeds(tmp_path) == {part: order.index(part) + 1 for part in ("surface", "board", "sweep")}
    for seed, part in enumerate((*order, order[0]), 4):
        before = seeds(tmp_path)
        render(tmp_path, part, seed, add=True)
        assert seeds(tmp_path) == before | {part: seed}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "truth"]


def test_two_runs_into_one_folder_lose_nothing(tmp_path):
    """One that adds a board while a sweep is being added waits for it: both are there in the end, beside the surface."""
    render(tmp_path, "surface", 1)
    board = threading.Thread(target=render, args=(tmp_path, "board", 3), kwargs={"add": True})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CaptureWriter, "finish", lambda writer, finish=CaptureWriter.finish: (meanwhile(board), finish(writer)))
        render(tmp_path, "sweep", 2, add=True)
    board.join()
    assert seeds(tmp_path) == {"surface": 1, "board": 3, "sweep": 2}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "truth"]


def meanwhile(thread: threading.Thread) -> None:
    """Start a thread, if it isn't started, and give it time to end: fifty times what it takes."""
    if thread.ident is None:
        thread.start()
        thread.join(1)


def test_what_another_run_has_written_meanwhile_is_refused_as_before(tmp_path):
    """The folder was free when the run began; without `add` the part of the other run stays."""
    session = Session(tmp_path, "board", {"seed": 2})
    session.check()
    render(tmp_path, "surface", 1)
    with pytest.raises(InputError, match="an earlier board, found a surface"), session.write({"name": "board"}):
        pass
    assert seeds(tmp_path) == {"surface": 1}


def test_a_part_alone_lies_where_it_always_lay(tmp_path):
    render(tmp_path / "old", "surface", 1)
    render(tmp_path / "new", "surface", 1, add=True)
    assert contents(tmp_path / "old") == contents(tmp_path / "new")
    assert {"truth/scene.json", "truth/settings.json", "truth/calibration/optics.yaml"} < contents(tmp_path / "old").keys()


def test_without_add_a_part_of_another_kind_is_refused_and_left_alone(tmp_path):
    render(tmp_path, "surface", 1)
    before = contents(tmp_path)
    with pytest.raises(InputError, match="an earlier board, found a surface; choose another out, or give add=true"):
        render(tmp_path, "board", 2)
    assert contents(tmp_path) == before


def test_parts_are_of_one_rig(tmp_path):
    render(tmp_path, "surface", 1)
    with pytest.raises(InputError, match=r"truth/settings\.json: rig: expected another as given, as all parts are of one rig"):
        render(tmp_path, "board", 2, add=True, rig="another")
    render(tmp_path, "surface", 3, add=True, rig="another")  # nothing else is there
    render(tmp_path, "board", 2, add=True, rig="another")


def test_the_field_is_named_by_which_another_rig_differs(tmp_path):
    """The first that differs, with both values; a field that one of them lacks is none there."""
    rig = {"cam1": {"size": [64, 48], "sensor": {"gain": 5.0}}, "cam2": {"size": [64, 48]}}
    render(tmp_path, "surface", 1, rig=rig)
    for given, complaint in (
        (
            rig | {"cam1": {"size": [64, 48], "sensor": {"gain": 6.0}}},
            r"rig\.cam1\.sensor\.gain: expected 6\.0 as given.* found 5\.0",
        ),
        (rig | {"cam2": {"size": [32, 24]}}, r"rig\.cam2\.size: expected \[32, 24\] as given.* found \[64, 48\]"),
        (rig | {"probe": 1}, r"rig\.probe: expected 1 as given.* found None"),
    ):
        with pytest.raises(InputError, match=rf"truth/settings\.json: {complaint}$"):
            render(tmp_path, "board", 2, add=True, rig=given)
    render(tmp_path, "board", 2, add=True, rig=rig)


def test_the_true_calibration_keeps_devices_that_other_parts_need(tmp_path):
    render(tmp_path, "surface", 1)
    with Session(tmp_path, "sweep", {}, True, CAMERAS).write(describe(scene("sweep"))) as (capture, truth):
        truth.write_optics(optics("cam1", "cam2"))
        times, images = dict.fromkeys(CAMERAS, np.arange(1)), [(name, noise(1, 2)[0]) for name in CAMERAS]
        capture.add_sweep(times, images, dict.fromkeys(CAMERAS, Device(size=SIZE)))
    assert list(TruthFolder(tmp_path / "truth", "surface").optics("projector")) == ["cam1", "projector", "cam2"]
    with pytest.raises(InputError, match="expected cam7, found cam1, projector, cam2"):
        TruthFolder(tmp_path / "truth", "sweep").optics("cam7")


@pytest.mark.parametrize("add", [False, True])
@pytest.mark.parametrize("step", range(2))
def test_a_rendering_that_stops_while_folders_change_places_leaves_a_pair(tmp_path, monkeypatch, step, add):
    """The truth is set aside, and the new one put in its place: where the first fails the old pair stands, else the new one."""
    render(tmp_path, "surface", 1)
    if add:
        render(tmp_path, "board", 2, add=True)
    before = contents(tmp_path)
    calls, rename = iter(range(1000)), Path.rename

    def fails(self, target):
        if self.parent == tmp_path and next(calls) == step:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, "surface", 3, add=add)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "truth"]
    assert (contents(tmp_path) == before) == (step == 0)
    others = {"board": 2} if add else {}
    assert seeds(tmp_path) == {"surface": 3 if step else 1} | others
    monkeypatch.undo()
    render(tmp_path, "surface", 3, add=add)
    assert seeds(tmp_path) == {"surface": 3} | others


def test_never_does_a_capture_stand_beside_another_truth(tmp_path, monkeypatch):
    """Whenever a folder has changed its place: a capture with its own truth, or with none."""
    render(tmp_path, "surface", 1)
    seen, rename = [], Path.rename

    def watched(self, target):
        done = rename(self, target)
        assert (tmp_path / "capture").is_dir()
        seen.append(seeds(tmp_path) if (tmp_path / "truth").is_dir() else None)
        return done

    monkeypatch.setattr(Path, "rename", watched)
    render(tmp_path, "surface", 2)
    assert [each for k, each in enumerate(seen) if k == 0 or each != seen[k - 1]] == [None, {"surface": 2}]


@pytest.mark.parametrize("add", [False, True])
def test_a_rendering_that_stops_between_two_images_changes_nothing(tmp_path, add):
    render(tmp_path, "sweep", 1)
    before = contents(tmp_path)

    def breaks_off():
        yield SCANNER, noise(1, 2)[0]
        raise KeyboardInterrupt

    session = Session(tmp_path, "sweep", {}, add, (SCANNER,))
    with pytest.raises(KeyboardInterrupt), session.write(describe(scene("sweep"))) as (capture, truth):
        truth.write_arrays("sweep/sweep.npz", {"seed": np.array(2)})
        capture.add_sweep({SCANNER: np.arange(2)}, breaks_off(), {SCANNER: Device(size=SIZE)})
    assert contents(tmp_path) == before and len(list(tmp_path.iterdir())) == 2


def test_what_a_killed_process_has_set_aside_is_not_lost_to_another_kind(tmp_path):
    """Its number is above the largest that a process has."""
    render(tmp_path, "surface", 1)
    before = contents(tmp_path)
    (tmp_path / "capture").rename(tmp_path / ".capture.4194305.old")
    with pytest.raises(InputError, match="an earlier board, found a surface"):
        render(tmp_path, "board", 2)
    assert contents(tmp_path) == before


def test_a_capture_whose_truth_is_lost_may_be_added_to(tmp_path):
    render(tmp_path, "surface", 1)
    shutil.rmtree(tmp_path / "truth")
    render(tmp_path, "sweep", 2, add=True)
    assert TruthFolder(tmp_path / "truth", "sweep").settings()["seed"] == 2
    assert manifest.read_manifest(tmp_path / "capture").contents.keys() == {"surface", "sweep"}
    Session(tmp_path, "sweep", {}, True, (SCANNER,)).check()


def test_a_scene_is_described_once(tmp_path):
    described = describe(scene("ball"), labels=["surroundings"], wires=[])
    assert list(described) == ["name", "labels", "wires", "shapes"]
    assert described["shapes"] == [{"kind": "sphere", "name": "ball", "centre": [0.0, 0.0, 650.0], "radius": 20.0}]


@pytest.mark.parametrize(("content", "complaint"), [(None, "found none"), ("{", "damaged"), ("[]", "found a list")])
@pytest.mark.parametrize("name", [SCENE, SETTINGS])
def test_damaged_truth_is_named(tmp_path, name, content, complaint):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name}: expected .*{complaint}") as refusal:
        getattr(TruthFolder(tmp_path, "board"), name.removesuffix(".json"))()
    assert "\n" not in str(refusal.value)


def test_truth_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / SETTINGS).mkdir()
    with pytest.raises(InputError, match=r"settings\.json: expected a file of the twin's ground truth, found a folder"):
        TruthFolder(tmp_path, "board").settings()


def test_settings_are_written_as_json(tmp_path):
    render(tmp_path, "surface", 1)
    text = (tmp_path / "truth" / "settings.json").read_text()
    assert text == json.dumps({"rig": "ours", "seed": 1}, indent=2) + "\n"


def test_sweeps_with_names_stand_side_by_side(tmp_path):
    """Each keeps its images, truth, settings and scene when another is added, or rendered anew."""
    for part, seed in (("sweep/wires", 1), ("sweep/scan", 2), ("surface", 3), ("sweep/wires", 4)):
        render(tmp_path, part, seed, add=True)
    assert seeds(tmp_path) == {"surface": 3, "sweep/scan": 2, "sweep/wires": 4}


def test_a_sweep_without_a_name_is_refused_beside_named_ones_and_the_other_way_round(tmp_path):
    render(tmp_path / "named", "sweep/wires", 1)
    render(tmp_path / "one", "sweep", 1)
    for out, part, found in (("named", "sweep", "sweep wires of us"), ("one", "sweep/wires", "sweep of us")):
        with pytest.raises(InputError, match=f"found a {found}; choose another out, or give all sweeps names"):
            Session(tmp_path / out, part, {}, True, (SCANNER,)).check()
