"""What the public functions are given is checked: a wrong kind, shape, size or range is one line that names the argument."""

import re
from dataclasses import replace

import numpy as np
import pytest

import sonotwin
from tests.recon.fringe_scenes import photograph

SIZE = (160, 128)
WRONG = {
    "a text": "paper_surface",
    "nothing": None,
    "an object": object(),
    "NaN": np.full((3, 4, 4), np.nan),
    "rows of several lengths": [[1, 2], [3]],
    "a list of texts": ["a", "b"],
    "a number": 5,
}


def devices(size=SIZE):
    """Two cameras of one size beside a projector, before a plane at 600 mm."""

    def camera(size, x, y):
        place = np.eye(4)
        place[:2, 3] = -x, -y
        return sonotwin.Camera(size, np.array([[600.0, 0, size[0] / 2], [0, 600, size[1] / 2], [0, 0, 1]]), np.zeros(5), place)

    return sonotwin.Calibration(
        {"cam1": camera(size, 0, 0), "cam2": camera(size, 120, 5), "projector": camera((320, 240), -100, 60)}
    )


def shown(patterns, name):
    """A camera's images of the plane."""
    cameras = devices().cameras
    rays = cameras[name].rays(cameras[name].pixel_grid())
    points = cameras[name].centre + rays * ((600 - cameras[name].centre[2]) / rays[..., 2])[..., None]
    places = cameras["projector"].project(points)
    maps = {"columns": places[..., 0], "rows": places[..., 1]}
    return photograph(patterns, {axis: maps[axis] for axis in patterns.axes}, np.random.default_rng(1))


def sequence(*axes):
    """Fringes with Gray code along some axes."""
    parts = [
        part
        for axis in axes
        for part in (
            {"kind": "fringes", "axis": axis, "pitch": 16, "steps": 8},
            {"kind": "gray", "axis": axis, "pitch": 16, "bits": 5, "inverted": True},
        )
    ]
    return sonotwin.Patterns(projector_size=(320, 240), unwrap="gray", parts=parts)


@pytest.fixture(scope="module")
def good():
    """Arguments of each function that it takes."""
    calibration, patterns = devices(), sequence("columns")
    images = shown(patterns, "cam1")
    found = sonotwin.decode(images, patterns, camera="cam1")
    camera, projector = calibration.cameras["cam1"], calibration.cameras["projector"]
    points = sonotwin.triangulate(found, camera, projector)
    board = sonotwin.AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9)
    lit = {"cam1": np.full(SIZE[::-1], 90, np.uint8)}
    sighting = sonotwin.find_board("00", board, lit, None, None, {"cam1": 8})
    matrices = np.array([np.diag([0.2, 0.2, 1, 1])] * 3, float)
    matrices[:, 2, 3] = range(3)
    corners = np.array([[0.0, 0, 0], [20, 0, 0], [0, 20, 1], [20, 20, 2]])
    grid = sonotwin.principal_grid(corners, 1.0)
    scans = np.full((3, 100, 100), 100, np.uint8)
    poses, pixels = np.array([np.eye(4)] * 8), np.full((8, 2), 50.0)
    return {
        "decode": {"images": images, "patterns": patterns, "bits": 8, "noise": None},
        "triangulate": {"projector_map": found, "camera": camera, "projector": projector},
        "clean_surface": {"point_map": points, "camera": camera, "modulation": found.modulation, "limits": None},
        "mesh_surface": {"point_map": points, "camera": camera, "grey": found.offset},
        "find_board": {"name": "00", "board": board, "lit": lit, "fringes": None, "patterns": None, "bits": {"cam1": 8}},
        "calibrate_optics": {"sightings": [sighting], "board": board, "sizes": {"cam1": SIZE}, "settings": None},
        "find_crossing": {"image": scans[0], "appearance": None},
        "calibrate_probe": {"sightings": sonotwin.Crossings(poses, pixels), "size": (100, 100)},
        "Crossings": {"poses": poses, "pixels": pixels, "pose_covariance": None},
        "principal_grid": {"around": corners, "spacing_mm": 1.0},
        "reconstruct_volume": {"images": list(scans), "world_from_pixel": matrices, "grid": grid},
        "find_masses": {"images": lambda: iter(scans), "shape": (100, 100), "world_from_pixel": matrices, "sound": None},
        "write_surface": {
            "folder": "capture",
            "images": {"cam1": images},
            "patterns": patterns,
            "optics": calibration,
            "devices": {"cam1": sonotwin.Device(size=SIZE), "projector": sonotwin.Device(size=(320, 240))},
        },
        "Camera": {"size": SIZE, "matrix": camera.matrix, "distortion": [0] * 5, "camera_from_world": np.eye(4)},
        "Calibration": {"cameras": dict(calibration.cameras), "uncertainty": None},
        "ProbeCalibration": {"target_from_image": np.eye(4), "scale": [0.1, 0.1], "uncertainty": None},
        "Track": {"times": np.arange(8), "poses": poses, "covariance": None},
        "build_scene": {"config": {"kind": "sphere"}},
        "render": {
            "rig": sonotwin.read_rig(),
            "scene": sonotwin.build_scene({"kind": "sphere"}),
            "patterns": patterns,
            "camera": "cam1",
            "tracing": sonotwin.Tracing(),
            "shooting": sonotwin.Shooting(),
            "seed": 1,
        },
    }


FREE = {  # arguments that take anything of a kind: a text, a path, none
    ("find_board", "name"), ("write_surface", "folder"), ("calibrate_probe", "size"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_wrong_kinds_are_refused_by_name(good, what, tmp_path, monkeypatch):
    """Each argument of each function, given something else, is named in one line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    for function, arguments in good.items():
        for name, right in arguments.items():
            if (function, name) in FREE or (right is None and what == "nothing") or (name, what) in TAKEN:
                continue
            given = arguments | {name: WRONG[what]}
            with pytest.raises(ValueError, match=r"expected .*found") as caught:
                made = getattr(sonotwin, function)(**given)
                if function == "Crossings":
                    sonotwin.calibrate_probe(made, (100, 100))
            assert "\n" not in str(caught.value) and "built-in" not in str(caught.value), (function, name, str(caught.value))
            assert re.search(rf"\b{name}\b|\bimage\b|\bscene\b", str(caught.value)), (function, name, str(caught.value))
    assert not list(tmp_path.iterdir())


TAKEN = {  # of a kind that is right
    ("world_from_pixel", "NaN"), ("poses", "NaN"), ("grey", "nothing"), ("modulation", "nothing"),
    ("camera_from_world", "nothing"), ("spacing_mm", "a number"), ("bits", "a number"), ("seed", "a number"), ("grid", "NaN"),
    ("image", "a number"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patterns": "paper_surface"}, "patterns: expected Patterns, found 'paper_surface'; sonotwin.read_patterns reads"),
        ({"images": lambda images: images[:5]}, "expected 18 grey images .* found shape \\(5, 128, 160\\)"),
        ({"images": lambda images: images / 255}, "expected grey levels from 0 to 255, found 0.* to 0.*: shares of white"),
        ({"images": lambda images: np.where(images > 50, np.nan, images)}, "expected finite 18 grey images"),
        ({"images": lambda images: np.uint16(images) * 16}, "from 0 to 255, as of bits=8"),
        ({"bits": 4}, "from 0 to 15, as of bits=4"),
        ({"bits": 12}, "expected 16-bit numbers, as of bits=12"),
        ({"bits": "8"}, "bits: expected a whole number from 1 to 16, found '8'"),
    ],
)
def test_images_are_grey_levels_of_their_bits(good, change, message):
    """Shares of white, NaN, deeper numbers and other counts are named."""
    right = good["decode"]
    given = right | {name: value(right[name]) if callable(value) else value for name, value in change.items()}
    with pytest.raises(sonotwin.InputError, match=message):
        sonotwin.decode(**given)


def test_another_cameras_calibration_is_refused():
    """By the camera's name, as columns alone fit any camera; by the rows, which contradict them; the right one passes."""
    cameras = devices().cameras
    for axes in (("columns",), ("columns", "rows")):
        patterns = sequence(*axes)
        images = shown(patterns, "cam1")
        for told in ("", "cam1"):
            found = sonotwin.decode(images, patterns, camera=told)
            points = sonotwin.triangulate(found, cameras["cam1"], cameras["projector"]).points
            assert np.isfinite(points).mean() > 0.8
            if told:
                with pytest.raises(sonotwin.InputError, match="camera: expected cam1, which took the images, found cam2"):
                    sonotwin.triangulate(found, cameras["cam2"], cameras["projector"])
            elif len(axes) == 2:
                with pytest.raises(sonotwin.InputError, match=r"columns and rows that agree .* another camera's"):
                    sonotwin.triangulate(found, cameras["cam2"], cameras["projector"])
    with pytest.raises(sonotwin.InputError, match="projector: expected another device than the camera, found cam1"):
        sonotwin.triangulate(found, cameras["cam1"], cameras["cam1"])
    other = replace(cameras["projector"], size=(1280, 800))
    with pytest.raises(sonotwin.InputError, match=r"projector: expected 320x240 px, as of the patterns, found 1280x800"):
        sonotwin.triangulate(found, cameras["cam1"], other)
    with pytest.raises(ValueError, match="columns: expected an image of shape"):
        sonotwin.triangulate(found, replace(cameras["cam1"], size=(128, 160)), cameras["projector"])


def test_sizes_exchanged_are_refused(good):
    """Height before width puts points out of the image."""
    board = good["find_board"]["board"]
    places = np.column_stack([np.linspace(900, 1250, 44), np.linspace(100, 900, 44)])
    sighting = replace(
        good["calibrate_optics"]["sightings"][0], pixels={"cam1": places}, covariance={"cam1": np.ones((44, 2, 2))}
    )
    with pytest.raises(sonotwin.InputError, match=r"00 cam1: expected points in its image of 1024x1280 px"):
        sonotwin.calibrate_optics([sighting], board, {"cam1": (1024, 1280)})
