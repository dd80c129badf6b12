"""`sonotwin import-sweep`: a scanner's clip and a tracker's table become a capture that other verbs take."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import sweep_part
from recon.geometry import rigid
from sonotwin.cli import main
from tests.recon.clips import made_clips
from tests.recon.clips.made_clips import BOX, SCREEN

COUNT, RATE_HZ = 24, 20.0
COLUMNS = ["columns.time=t", "columns.translation=[x,y,z]", "columns.quaternion=[qx,qy,qz,qw]"]
PROBE = """%YAML:1.0
---
"""


@pytest.fixture
def folder(tmp_path):
    """A clip as a DICOM file and as a video, and a table of poses that begins a second before."""
    shown = made_clips.screens(made_clips.scans(COUNT))
    made_clips.write_dicom(tmp_path / "scan.dcm", shown, FrameTime=1e3 / RATE_HZ)
    made_clips.write_video(tmp_path / "screen.avi", shown, RATE_HZ)
    times = 99.0 + np.arange(60) / 20
    lines = [f"{time:.6f},{0.0:.6f},{10 * (time - 99):.6f},650,0,0,0,1" for time in times]
    (tmp_path / "poses.csv").write_text("t,x,y,z,qx,qy,qz,qw\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


def imported(folder, *fields: str) -> int:
    return main(["import-sweep", f"poses={folder / 'poses.csv'}", *COLUMNS, f"out={folder / 'capture'}", *fields])


def test_a_dicom_clip_becomes_a_sweep(folder, capsys):
    """Cut to its region, at its times by the table's clock, with the table's poses."""
    assert imported(folder, f"clip={folder / 'scan.dcm'}", "starts_s=100") == 0
    said = capsys.readouterr().out
    assert "120x96 px from (40, 30), as the file says" in said
    assert "rig.probe.image_size=[120,96] rig.probe.scale_mm_per_px=[0.125,0.119]" in said
    sweep = sweep_part.read_sweep(folder / "capture")
    assert sweep.size == BOX[2:] and (np.stack(list(sweep.images())) == made_clips.scans(COUNT)).all()
    assert sweep.times == pytest.approx(1e9 * (100 + np.arange(COUNT) / RATE_HZ), abs=2)
    assert sweep.poses()[:, 1, 3] == pytest.approx(10 * (1 + np.arange(COUNT) / RATE_HZ), abs=1e-4)


def test_a_video_of_the_screen_is_cut_to_what_changes(folder, capsys):
    assert imported(folder, f"clip={folder / 'screen.avi'}") == 0
    assert "which changes from frame to frame" in capsys.readouterr().out
    sweep = sweep_part.read_sweep(folder / "capture")
    assert np.abs(np.subtract(sweep.size, BOX[2:])).max() <= 8  # of blocks of JPEG about its edges
    assert sweep.times[0] == 99 * 10**9 and len(sweep.paths) == COUNT


def test_a_volume_is_two_commands_from_a_clip(folder):
    """The probe's calibration is the user's own."""
    from recon.capture import probe_files
    from recon.model.probe import ProbeCalibration

    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    probe_files.write(folder / "probe.yaml", ProbeCalibration(rigid.transform(turn, [0, 0, 20]), np.array([0.125, 0.119])))
    assert imported(folder, f"clip={folder / 'scan.dcm'}", "starts_s=100") == 0
    fields = [f"capture={folder / 'capture'}", f"probe={folder / 'probe.yaml'}", f"out={folder / 'volume'}"]
    assert main(["freehand", *fields]) == 0
    assert (folder / "volume" / "volume.nrrd").is_file()


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        (["clip={}/scan.dcm", "starts_s=500"], "starts_s: expected frames while there are poses, 99.000 to 101.950 s"),
        (["clip={}/scan.dcm", "crop=[100,100,200,60]"], "crop: expected a part of 240x160 px, found 300x160"),
        (["clip={}/scan.dcm", "columns.time=clock"], "poses.csv: line 1: expected a column clock"),
        (["clip={}/gone.dcm"], "gone.dcm: expected a file, found none"),
        (["clip={}/poses.csv"], "poses.csv: expected a DICOM file, a video or a folder of images"),
        (["clip={}/scan.dcm", "columns.quaternion=null"], "columns: expected quaternion or matrix, found neither"),
        (["clip={}/scan.dcm", "crop=half"], "crop"),
    ],
)
def test_mistakes_are_refused_in_one_line_and_nothing_is_written(fields, complaint, folder, capsys):
    assert imported(folder, *(field.format(folder) for field in fields)) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1 and not (folder / "capture").exists()


def test_a_region_beyond_the_image_is_refused_in_one_line(folder, capsys):
    """As in files that were shrunk or cropped since."""
    made_clips.write_dicom(folder / "scan.dcm", made_clips.scans(COUNT), FrameTime=50.0)
    assert imported(folder, f"clip={folder / 'scan.dcm'}") == 2
    said = capsys.readouterr().err
    assert "expected a region within the image of 120x96 px, found 120x96 px from (40, 30)" in said and said.count("\n") == 1
    assert imported(folder, f"clip={folder / 'scan.dcm'}", "crop=whole") == 0
    assert "scale_mm_per_px" not in capsys.readouterr().out


def test_images_need_a_rate(folder, capsys):
    import cv2

    (folder / "images").mkdir()
    for number, image in enumerate(made_clips.scans(COUNT)):
        cv2.imwrite(str(folder / "images" / f"{number}.png"), image)
    assert imported(folder, f"clip={folder / 'images'}") == 2
    assert "expected times of the frames, found none; give rate_hz=" in capsys.readouterr().err
    assert imported(folder, f"clip={folder / 'images'}", "rate_hz=10", "crop=whole") == 0
    assert np.diff(sweep_part.read_sweep(folder / "capture").times).tolist() == [10**8] * (COUNT - 1)
    assert BOX[2:] != SCREEN


def test_stills_with_a_row_each_in_a_plain_table(folder, capsys):
    """Neither header nor times: each image has the pose of its row, and a volume is made of them."""
    import cv2

    (folder / "images").mkdir()
    for number, image in enumerate(made_clips.scans(COUNT)):
        cv2.imwrite(str(folder / "images" / f"{number}.png"), image)
    rows = [f"{0.0} {k} 650 0 0 0 1" for k in range(COUNT)]
    (folder / "poses.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    columns = "columns={time: null, translation: [1,2,3], quaternion: [4,5,6,7]}"
    fields = [f"clip={folder / 'images'}", f"poses={folder / 'poses.csv'}", columns, "crop=whole", f"out={folder / 'capture'}"]
    assert main(["import-sweep", *fields]) == 0
    assert f"{COUNT} of {COUNT} frames have one" in capsys.readouterr().out
    assert sweep_part.read_sweep(folder / "capture").poses()[:, 1, 3].tolist() == list(range(COUNT))
    (folder / "probe.txt").write_text("0.125 0 0 5\n0 0 -1 0\n0 0.119 0 20\n0 0 0 1\n")
    given = [f"capture={folder / 'capture'}", f"probe={folder / 'probe.txt'}", f"out={folder / 'volume'}", "hole_voxels=0"]
    assert main(["freehand", *given]) == 0


def test_poses_of_another_unit_or_at_rest_are_named(folder, capsys, caplog):
    """In metres and without any tracking they are refused; in centimetres they may be right, which the user is asked."""
    table = folder / "poses.csv"
    header, *rows = (line.split(",") for line in table.read_text().splitlines())
    for factor, moving, complaint in (
        (1e-3, 1, "metres? give columns.length_unit; to use them all the same, give implausible=take"),
        (1, 0, "found all 60 the same to the last digit: no tracking, or a probe at rest? to use them all the same"),
        (0.1, 1, "up to 65.1 mm from the origin, at 1 mm/s: is it in mm, not in centimetres or inches? Else give columns"),
    ):
        lines = [[t, x, str(moving * factor * float(y)), str(factor * float(z)), *q] for t, x, y, z, *q in rows]
        table.write_text("\n".join(map(",".join, [header, *lines])) + "\n")
        status = imported(folder, f"clip={folder / 'scan.dcm'}", "starts_s=100")
        assert (status, complaint in capsys.readouterr().err + caplog.text) == (0 if factor == 0.1 else 2, True)


def test_poses_that_cover_a_part_of_the_clip_are_counted(folder, capsys):
    assert imported(folder, f"clip={folder / 'scan.dcm'}", "starts_s=101.5") == 0
    said = capsys.readouterr().out
    assert "B-scans have no pose: 0 before the first pose, " in said and "does the clip begin with the table?" in said
