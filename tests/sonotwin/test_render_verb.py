"""`sonotwin render`: what it writes, and what it refuses before it renders."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files
from recon.capture.board_part import read_board
from recon.errors import InputError
from recon.geometry import rigid
from recon.model import circle_layout
from scenes.catalogue import build_scene
from scenes.handheld import lofts
from scenes.scene_types import Material, Thing
from sonotwin import config, read_rig
from sonotwin.cli import main
from sonotwin.verbs import render, sweep
from twin.filmed_sweep import plan_sweep
from twin.standing_bodies import with_standing
from twin.tracking.led_bodies import LedBodies

SMALL = [  # both cameras at an eighth of their size
    "rig.cam1.sensor.pixel_um=38.4",
    "rig.cam1.optics.size=[160,128]",
    "rig.cam1.optics.focal_px=[415.0,416.375]",
    "rig.cam1.optics.centre_px=[76.8125,64.9375]",
    "rig.cam2.sensor.pixel_um=38.4",
    "rig.cam2.optics.size=[160,128]",
    "rig.cam2.optics.focal_px=[414.75,416.125]",
    "rig.cam2.optics.centre_px=[76.0625,64.3125]",
]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["scene=brest"], "scene: expected one of ball_bar, board, breast,"),
        (["scene.radius_mm=3"], "scene.radius_mm: unknown key"),
        (["scene=sphere", "scene.radius_mm=-3"], "radius_mm: expected greater than 0, found -3"),
        (["patterns=paper"], "patterns: expected one of"),
        (["scene=[[[]]]"], "scene: expected one of ball_bar, board, breast,"),
        (["rig=null"], "rig: expected one of meza2021, three_bodies, found null; leave it out"),
        (["patterns.unwrap=luck"], "patterns.unwrap: expected"),
        (["patterns.projector_size=[1920,1080]"], "patterns.projector_size: expected the rig's [1280, 800], found [1920, 1080]"),
        (["rig.projector.gama=2"], "gamma, contrast; did you mean rig.projector.gamma?"),
        (
            ["rig.cam1.sensor.quantum_efficiency=1.4"],
            "rig.cam1.sensor.quantum_efficiency: expected less than or equal to 1, found 1.4",
        ),
        (["rig.cam1.optics.distortion=[0.1]"], "rig.cam1.optics.distortion: expected 0, 4, 5, 8, 12 or 14 coefficients, found 1"),
        (["tracing.samples=12"], "tracing.samples: expected a power of two, found 12"),
        (["shooting.bits=12"], "shooting.bits: expected at most the 10 of cam1's ADC, found 12"),
        (["cameras=[cam3]"], "cameras.0: expected 'cam1' or 'cam2', found 'cam3'"),
        (["poses=paper"], "poses: expected scene=board with them, found scene.kind breast"),
        (["scene=board", "poses=papers"], "poses: expected one of demo, none, paper, found papers; did you mean paper?"),
        (
            ["scene=board", "poses=demo", "patterns=gray_surface"],
            "patterns: expected fringes or Gray code along both axes with poses, found none along rows",
        ),
        (
            ["scene=board", "poses=demo", "patterns=paper_calibration", "cameras=[cam2]"],
            "cameras: expected cam1, which sees the fringes of poses, found cam2",
        ),
        (
            ["scene=board", "poses=demo", "patterns=paper_calibration", "scene.spacing_mm=40", "scene.margin_mm=20"],
            "poses.depth_mm: expected room for the board in all views, found none at",
        ),
        (["scene=board", "poses=demo", "poses.tilt_deg=-3"], "poses.tilt_deg: expected greater than or equal to 0, found -3"),
        (["seed=-1"], "seed: expected greater than or equal to 0, found -1"),
    ],
)
def test_nonsense_is_refused_by_name(arguments, complaint, tmp_path, capsys):
    """One line, exit status 2, nothing written."""
    assert main(["render", f"out={tmp_path / 'out'}", *arguments]) == 2
    message = capsys.readouterr().err
    assert complaint in message and message.count("\n") == 1 and message.startswith("sonotwin: ")
    assert not (tmp_path / "out").exists()


def test_a_demo_shows_fringes(tmp_path, capsys):
    """Its page is of phases and orders, which Gray code alone has not."""
    assert main(["demo", f"out={tmp_path / 'out'}", "patterns=gray_alone"]) == 2
    assert "demo: patterns: expected fringes, whose phase the page shows" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_place_that_is_taken_is_refused_before_rendering(tmp_path, capsys):
    """A folder with other files, or a file, is left as it is."""
    (tmp_path / "out" / "truth").mkdir(parents=True)
    (tmp_path / "out" / "truth" / "thesis.tex").write_text("years of work")
    assert main(["render", f"out={tmp_path / 'out'}"]) == 2
    assert "expected a new or empty folder" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["truth"]
    (tmp_path / "file").write_text("")
    assert main(["render", f"out={tmp_path / 'file'}"]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_both_cameras(tmp_path, capsys):
    """Each camera has its images and its truth; 10-bit images are announced as such."""
    fields = [*SMALL, "scene=plane", "tracing.samples=2", "cameras=[cam1,cam2]", "shooting.bits=10", "shooting.exposure_s=0.02"]
    assert main(["render", f"out={tmp_path / 'out'}", *fields]) == 0
    manifest = json.loads((tmp_path / "out" / "capture" / "manifest.json").read_text())
    assert sorted(manifest["surface"]["images"]) == ["cam1", "cam2"]
    assert manifest["devices"]["cam2"] == {"size": [160, 128], "bits": 10, "exposure_s": 0.02, "gain": 1.0}
    assert sorted(path.name for path in (tmp_path / "out" / "truth" / "surface").iterdir()) == ["cam1.npz", "cam2.npz"]
    assert "exposure 20.00 ms" in capsys.readouterr().out


def test_a_board_in_poses(tmp_path, capsys):
    """Two poses of a few circles with warp and print errors: what the reader finds, and the truth beside it."""
    fields = ["scene=board", "poses=demo", "poses.count=2", "patterns=paper_calibration", "cameras=[cam1,cam2]"]
    fields += ["scene.columns=3", "scene.rows=5"]
    fields += [*SMALL, "tracing.samples=2", "scene.warp_mm=0.2", "scene.print_error_mm=0.02"]
    assert main(["render", f"out={tmp_path / 'out'}", *fields]) == 0
    found = read_board(tmp_path / "out" / "capture")
    assert (found.poses, found.cameras) == (("00", "01"), ("cam1", "cam2"))
    pose = found.pose(1)
    assert pose.fringes.shape == (50, 128, 160) and pose.lit["cam2"].shape == (128, 160)
    truth = np.load(tmp_path / "out" / "truth" / "board.npz")
    assert truth["world_from_board"].shape == (2, 4, 4) and truth["pixels"].shape == (2, 15, 3, 2)
    apart = truth["points"] - found.board.points()
    assert 0.01 < apart[:, :2].std() < 0.04 and 0.1 < np.abs(apart[:, 2]).max() <= 0.2
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["capture", "truth"]
    assert "2 poses, 50 patterns, 2 samples/px" in capsys.readouterr().out


def test_a_board_that_stands_beside_the_scene_is_under_the_fringes(tmp_path):
    """Its rings are dark and its holes bright where the truth has them, in both views; what a hand holds isn't there."""
    fields = ["rig=three_bodies", "scene=plane", "scene.centre_mm=[4,-2,700]", "cameras=[cam1,cam2]", *SMALL]
    assert main(["render", f"out={tmp_path}", *fields]) == 0
    bodies = tmp_path / "truth" / "surface" / "bodies"
    assert [path.name for path in bodies.iterdir()] == ["patient.npz"]
    pose = np.load(bodies / "patient.npz")["world_from_target"]
    target = read_rig("three_bodies").bodies["patient"]
    cameras = calibration_files.read(tmp_path / "truth" / "calibration" / "optics.yaml").cameras
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(40)])
    middle_mm = (target.outer_diameter_mm + target.inner_diameter_mm) / 4  # of the ring
    for name in ("cam1", "cam2"):
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((tmp_path / "capture/surface" / name).iterdir())]
        mean = np.mean(images, axis=0, dtype=np.float32)
        for centre in circle_layout.circle_centres(target):
            ring, hole = (
                cv2.remap(
                    mean, *np.float32(cameras[name].project(rigid.apply(pose, centre + r * circle)).T), cv2.INTER_LINEAR
                ).mean()
                for r in (middle_mm, 0.2 * middle_mm)
            )
            assert hole > 3 * ring


def test_a_board_stands_on_what_lies_below_it():
    """On its foot, on a block that is as high as a plane, and on a higher one."""
    rig, led = read_rig("three_bodies"), LedBodies()
    for step_mm in (0.0, 15.0):
        plane = build_scene({"kind": "plane", "centre_mm": [4, -2, 720.0]})
        box = lofts.box([60, 60, step_mm + 1], [-82, 66, 720.5 - step_mm / 2])  # the lower 1 mm of it in the plane
        scene = replace(plane, things=(*plane.things, Thing("block", box, Material(0.5), smooth=False)))
        whole, poses = with_standing(scene, rig, rig, led, 3)
        parts = [thing.mesh for thing in whole.things if thing.name.startswith("patient")]
        assert list(poses) == ["patient"] and len(parts) == len(whole.things) - len(scene.things)
        assert max(mesh.bounds[1, 2] for mesh in parts) == pytest.approx(720 - step_mm, abs=0.01)
        assert all(mesh.is_watertight for mesh in parts)
    with pytest.raises(InputError, match=r"bodies\.third\.path: needs a value: 2 bodies stand beside what is scanned"):
        crowded = rig.model_copy(update={"bodies": dict.fromkeys(("first", "second", "third"), rig.target)})
        with_standing(plane, crowded, crowded, led, 3)


def test_a_board_keeps_its_place_from_the_fringes_to_the_sweep():
    """However its print, the cameras and the hand err."""
    fields, body = ["rig=three_bodies", "scene=test_object", "conditions=lifelike", "seed=5", "out=unused"], "patient"
    made = config.load("render", fields, render.Config)
    used, _, under_fringes = render.set_up(made)
    assert used.bodies[body] != made.rig.bodies[body] and used.cam1 != made.rig.cam1
    small = ["rig.probe.image_size=[48,128]", "ultrasound.image_size=[48,128]", "path=hold", "path.seconds=1", "filmed=true"]
    swept = plan_sweep(config.load("sweep", [*fields, *small], sweep.Config)).bodies[body].truth.poses
    np.testing.assert_allclose(swept, np.broadcast_to(under_fringes[body], swept.shape), atol=1e-9)
