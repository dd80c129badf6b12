"""Files of a capture and of other groups, damaged or made to harm: a value or one line, at once, and nothing else."""

import io
import json
import struct
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recon.capture import lag_files, meza2021_sweep, sweep_tables
from recon.capture.images import read_images
from recon.capture.manifest import read_manifest
from recon.capture.surface_part import read_patterns
from recon.clips import pose_tables
from recon.clips.pose_tables import Columns
from recon.errors import InputError
from recon.files import medical_images, meshes, npz, volumes
from recon.files.npz import Form
from recon.freehand import plus_config, sequences
from recon.freehand.sequences import FrameNames
from tests.recon import bounded_work
from tests.recon.files.mutations import damaged

MANIFEST = {
    "schema": "sonotwin-capture/1",
    "devices": {"cam1": {"size": [64, 48], "exposure_s": 0.01}, "projector": {"size": [1280, 800]}},
    "calibration": "calibration/optics.yaml",
    "board": {
        "board": {"kind": "chessboard", "columns": 4, "rows": 3, "square_mm": 5},
        "poses": [{"name": "00", "lit": {"cam1": "board/00/cam1/0000.png"}}],
    },
}
POSE = "1,0,0,10.5,0,1,0,-3,0,0,1,600"
TRACK = f"{','.join(sweep_tables.TRACK)}\n0,1,{POSE}\n1000,0{',' * 12}\n2000,1,{POSE}\n".encode()
PATTERNS = (
    b"projector_size: [1280, 800]\nunwrap: centre_line\nparts:\n- {kind: centre_line}\n- {kind: fringes, pitch: 12, steps: 8}\n"
)
PLUS = b"""<?xml version="1.0"?><PlusConfiguration><CoordinateDefinitions>
<Transform From="Image" To="Probe" Matrix="0.1 0 0 5  0 0.1 0 0  0 0 0.1 0  0 0 0 1"/></CoordinateDefinitions>
<VolumeReconstruction OutputSpacing="1 1 1" ImageCoordinateFrame="Image" ClipRectangleOrigin="0 0" ClipRectangleSize="90 80"
FanAngles="-30 30" FanOrigin="40 -10" FanRadiusStartPixel="5" FanRadiusStopPixel="90" FillHoles="OFF"/></PlusConfiguration>"""
POSES = b"t;x;y;z;qx;qy;qz;qw\n0.0;1;2;3;0;0;0;1\n0.1;1;2;3;0;0;1;0\n0.2;;;;;;;\n"
COLUMNS = Columns(time="t", translation=("x", "y", "z"), quaternion=("qx", "qy", "qz", "qw"))
LAG = b'{"lag_s": 0.05, "sigma_s": 0.001, "interval_s": [0.048, 0.052], "coverage": 0.95}'


def sequence() -> bytes:
    fields = "".join(
        f"Seq_Frame{k:04d}_ProbeToTrackerTransform = 1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1\nSeq_Frame{k:04d}_Timestamp = {k}.5\n"
        f"Seq_Frame{k:04d}_ImageStatus = OK\n"
        for k in range(2)
    )
    head = "ObjectType = Image\nNDims = 3\nDimSize = 4 3 2\nElementType = MET_UCHAR\nUltrasoundImageOrientation = MF\n"
    return f"{head}{fields}ElementDataFile = LOCAL\n".encode() + bytes(range(24))


def ply() -> bytes:
    mesh = trimesh.creation.icosahedron()
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    faces = b"".join(struct.pack("<B3i", 3, *face) for face in mesh.faces.tolist())
    return head.encode() + mesh.vertices.astype("<f4").tobytes() + faces


def archive() -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, points=np.arange(12.0).reshape(4, 3))
    return stream.getvalue()


def array() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.tile(np.eye(4), (2, 1, 1)))
    return stream.getvalue()


def tracked(path):
    found = sequences.read_sequence(path)
    sequences.poses(found, FrameNames().target, "Tracker")


READERS = {
    "manifest.json": (json.dumps(MANIFEST).encode(), lambda path: read_manifest(path.parent)),
    "track.csv": (TRACK, sweep_tables.read_track),
    "timestamps.csv": (b"frame,time_ns\n0,100\n1,200\n", sweep_tables.read_stamps),
    "patterns.yaml": (PATTERNS, read_patterns),
    "lag.json": (LAG, lag_files.read),
    "plus.xml": (PLUS, plus_config.read_config),
    "poses.csv": (POSES, lambda path: pose_tables.read(path, COLUMNS)),
    "sequence.mha": (sequence(), tracked),
    "mesh.ply": (ply(), lambda path: meshes.read_ply(path, "a mesh")),
    "arrays.npz": (archive(), lambda path: npz.read(path, {"points": Form("f", (None, 3))})),
    "target_pose.npy": (array(), npz.read_npy),
}


@pytest.mark.parametrize("name", READERS)
def test_whole_files_are_read(name, tmp_path):
    whole, read = READERS[name]
    (tmp_path / name).write_bytes(whole)
    read(tmp_path / name)


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_gives_a_value_or_one_line(name, tmp_path, data):
    whole, read = READERS[name]
    (tmp_path / name).write_bytes(data.draw(damaged(whole)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # which would be lines on the console
        try:
            with bounded_work.calls(1e5):
                read(tmp_path / name)
        except InputError as error:
            assert "\n" not in str(error)


def refused_cheaply(read, path, calls: float = 1e4, most: float = 2e7) -> str:
    """The refusal of a file, which takes neither work nor memory."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as refusal, bounded_work.calls(calls):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    return str(refusal.value).removeprefix(f"{path}: ")


def test_an_archive_that_unpacks_to_gigabytes_is_refused_before(tmp_path):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed, packed.open("points.npy", "w") as stream:
        for _ in range(513):
            stream.write(bytes(1 << 20))
    read = READERS["arrays.npz"][1]
    assert refused_cheaply(read, path) == "expected arrays of up to 512 MiB, found 513 MiB"


def test_an_array_that_declares_more_than_it_has_is_refused(tmp_path):
    path = tmp_path / "target_pose.npy"
    path.write_bytes(array().replace(b"(2, 4, 4)", b"(9999999999, 4, 4)")[: len(array())])
    with pytest.raises(InputError, match="expected an array of numbers, found other or damaged data"):
        meza2021_sweep.read_rows(path, (4, 4))


def test_a_volume_that_unpacks_to_more_than_its_voxels_is_refused(tmp_path):
    path = tmp_path / "bomb.nrrd"
    volumes.write_volume(path, volumes.Volume(np.zeros((400, 400, 400), np.uint8), np.zeros(3), np.ones(3)))
    path.write_bytes(path.read_bytes().replace(b"sizes: 400 400 400", b"sizes: 4 4 4"))
    assert refused_cheaply(volumes.read_volume, path) == "sizes: expected numbers of all voxels, found [4 4 4], and more data"


@pytest.mark.parametrize("name", ["../elsewhere.raw", "/etc/hostname", "folder", "none.raw"])
def test_pixels_lie_beside_their_header(tmp_path, name):
    (tmp_path / "elsewhere.raw").write_bytes(bytes(64))
    (tmp_path / "own" / "folder").mkdir(parents=True)
    path = tmp_path / "own" / "volume.mhd"
    path.write_text(f"NDims = 3\nDimSize = 4 4 4\nElementType = MET_UCHAR\nElementDataFile = {name}\n")
    with pytest.raises(InputError, match="data file: expected LOCAL or the name of a file"):
        medical_images.read_header(path)
    detached = path.with_suffix(".nhdr")
    detached.write_text(f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nencoding: raw\ndata file: {name}\n")
    with pytest.raises(InputError, match="data file: expected LOCAL or the name of a file"):
        volumes.read_volume(detached)


def test_frames_without_number_are_refused(tmp_path):
    path = tmp_path / "tracking.mha"
    path.write_text("NDims = 3\nDimSize = 0 0 999999999\nElementType = MET_OTHER\nElementDataFile = LOCAL\n")
    assert "DimSize: expected frames of which most have fields" in refused_cheaply(sequences.read_tracking, path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda m: m["devices"]["cam1"].update(size=[10**9, 10**9]), "devices.cam1.size.0: expected less than or equal to 20000"),
        (lambda m: m["devices"]["cam1"].update(exposure_s=1e308), "devices.cam1.exposure_s: expected numbers of up to 1e+12"),
        (
            lambda m: m["board"]["board"].update(columns=10**6),
            "board.board.columns: expected less than or equal to 100",
        ),
        (lambda m: m["board"]["poses"][0].update(name="../../x"), "board.poses.0.name: expected a name without slashes"),
        (lambda m: m["board"]["poses"][0]["lit"].update(cam1="/etc/passwd"), "board.poses.0.lit.cam1: expected a path within"),
        (lambda m: m["board"]["poses"][0]["lit"].update(cam1="a/../../b"), "board.poses.0.lit.cam1: expected a path within"),
        (lambda m: m["devices"].update({"../x": {"size": [64, 48]}}), "devices.../x.[key]: expected a name without slashes"),
        (lambda m: m.update(name=["x"] * 10**6), "name: expected string, found ['x', 'x', 'x'"),
    ],
)
def test_a_manifest_that_asks_for_too_much_is_refused(tmp_path, change, complaint):
    content = json.loads(json.dumps(MANIFEST))
    change(content)
    (tmp_path / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as refusal:
        read_manifest(tmp_path)
    assert str(refusal.value).startswith(f"{tmp_path / 'manifest.json'}: {complaint}") and len(str(refusal.value)) < 400


def test_memory_for_a_stack_is_asked_for_once_an_image_is_there(tmp_path):
    with pytest.raises(InputError, match=r"0\.png: expected a file, found none"):
        read_images([tmp_path / f"{k}.png" for k in range(1000)], (20000, 20000), 12)


@pytest.mark.parametrize("value", ["1e308", "nan", "inf", "-1e30"])
def test_poses_beyond_all_reason_are_refused(tmp_path, value):
    (tmp_path / "track.csv").write_bytes(TRACK.replace(b"10.5", value.encode()))
    with pytest.raises(InputError, match=r"track\.csv: line 2: "):
        sweep_tables.read_track(tmp_path / "track.csv")
    (tmp_path / "poses.csv").write_bytes(POSES.replace(b";3;", f";{value};".encode(), 1))
    if value not in ("nan", "inf"):  # of a target that wasn't found
        with pytest.raises(InputError, match=r"poses\.csv: line 2: "):
            pose_tables.read(tmp_path / "poses.csv", COLUMNS)


@pytest.mark.parametrize(
    ("at", "value", "complaint"),
    [
        (-4, struct.pack("<i", 99), "expected a mesh of triangles between its 12 vertices, found one of 0 to 99"),
        (-4, struct.pack("<i", -1), "expected a mesh of triangles between its 12 vertices, found one of -1 to 11"),
        (ply().index(b"end_header\n") + 11, struct.pack("<f", np.nan), "expected a mesh of finite places, below 1e+07 mm"),
    ],
)
def test_corners_and_places_of_a_mesh_are_checked_as_it_is_read(tmp_path, at, value, complaint):
    data, at = ply(), at % len(ply())
    path = tmp_path / "mesh.ply"
    path.write_bytes(data[:at] + value + data[at + 4 :])
    with pytest.raises(InputError) as refusal:
        meshes.read_ply(path, "a mesh")
    assert str(refusal.value).startswith(f"{path}: {complaint}")


def test_a_mesh_whose_header_lost_a_space_is_refused_in_one_line(tmp_path):
    """Faces before vertices, `propertyfloat x`: trimesh stumbles over a name of its own that was never bound."""
    lines = ["ply", "format binary_little_endian 1.0", "element face 20", "element vertex 12", "propertyfloat x"]
    lines += ["property float y", "property float z", "property list uchar int vertex_indices", "end_header\n"]
    path = tmp_path / "mesh.ply"
    path.write_bytes("\n".join(lines).encode() + ply().partition(b"end_header\n")[2])
    with pytest.raises(InputError) as refusal:
        meshes.read_ply(path, "a mesh")
    assert str(refusal.value).startswith(f"{path}: expected a mesh as PLY, found a damaged one: ")
    assert "\n" not in str(refusal.value)
