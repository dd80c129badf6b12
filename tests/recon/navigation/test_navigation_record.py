"""A navigation's table: a row a moment and body, readable at any time, in no other's place."""

import csv

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.navigation.moving_bodies import MovingBodies
from recon.navigation.navigation_record import RecordTable
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import Moment
from recon.navigation.tool_distances import surface_of
from tests.recon.navigation.bodies_seen import NEEDLE, OWN, PATIENT, PROBE, SHARED, seen, three, unseen

STEP = rigid.from_rotation_vector([0.03, -0.05, 0.06], [14, -9, 30])
TIP = Tip(np.array([0.0, 5, -150]), np.diag([0.01] * 3 + [1e-6] * 3), np.array([0.0, 0, -1]))
CORNERS = np.array([[0, 0, 700], [9, 0, 700], [0, 9, 700], [0, 0, 709.0]])
MASS = surface_of(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


@pytest.fixture
def moving():
    reference = Track(np.array([5]), PATIENT[None], OWN[None], SHARED[None])
    return MovingBodies({"needle": TIP}, {"mass0": MASS}, np.array([[0.0, 0, 700], [0, 0, 760]]), reference)


def moment(moving, found, number=1):
    placed = moving.place(found, number)
    scan = PlacedScan(np.zeros((20, 10), np.uint8), 0, 0, PROBE)
    bodies = moving.measure(placed, scan)
    return Moment(number, 10**9, placed.world_from_target, placed.state, scan, bodies=bodies, frame_ns=777)


def rows(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def pose(row):
    return np.array([float(row[f"m{i}{j}"]) for i in range(3) for j in range(4)]).reshape(3, 4)


def test_a_row_holds_what_the_moment_has_to_the_last_digit(moving, tmp_path):
    record = RecordTable(tmp_path / "record.csv", ["needle", "patient"], ["mass0"])
    at = moment(moving, {name: seen(STEP @ one.pose.world_from_target) for name, one in three().items()})
    record.publish(at)
    probe, needle, patient = rows(tmp_path / "record.csv")  # while it is still open
    record.close()
    assert [row["body"] for row in (probe, needle, patient)] == ["probe", "needle", "patient"]
    assert probe["frame_ns"] == "777" and probe["state"] == "target predicted" and probe["found"] == "1"
    np.testing.assert_array_equal(pose(probe), at.world_from_target[:3])
    np.testing.assert_allclose(pose(needle), NEEDLE[:3], atol=1e-9)
    np.testing.assert_allclose(pose(patient), (STEP @ PATIENT)[:3], atol=1e-9)  # the patient's own motion
    figures = at.bodies[0].figures
    assert [float(needle[f"tip_{axis}_mm"]) for axis in "xyz"] == figures.tip.tolist()
    assert (float(needle["mass0_mm"]), float(needle["mass0_sigma_mm"])) == figures.masses["mass0"]
    assert float(needle["tip_sigma_mm"]) == figures.sigma_mm and float(needle["path_deg"]) == figures.path.angle_deg
    assert float(needle["crossing_u_px"]) == figures.plane.crossing.pixel[0] and float(needle["aim_mm"]) == figures.path.left_mm
    assert probe["tip_x_mm"] == patient["mass0_mm"] == ""


def test_what_is_not_seen_has_its_reason_and_no_numbers(moving, tmp_path):
    record = RecordTable(tmp_path / "record.csv", ["needle", "patient"], ["mass0"])
    record.publish(moment(moving, three(needle=unseen("camera 2: 0 of 3 circles"))))
    record.publish(moment(moving, three(patient=unseen()), 2))
    record.publish(Moment(2, 2 * 10**9, None, "no frames of both cameras"))
    found = rows(tmp_path / "record.csv")
    record.close()
    assert [(row["moment"], row["found"]) for row in found] == [*zip("111222222", "101000000", strict=True)]
    assert found[1]["state"] == "not found: camera 2: 0 of 3 circles" and found[4]["state"] == "patient not found"
    assert {row["state"] for row in found[6:]} == {"no frames of both cameras"}
    assert all(row[name] == "" for row in found if row["found"] == "0" for name in ("m00", "tip_x_mm", "mass0_mm", "path_mm"))


def test_another_file_is_never_replaced(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text("of others")
    with pytest.raises(InputError, match=r"record: expected a new file, found .*record\.csv there already"):
        RecordTable(path, [], [])
    assert path.read_text() == "of others"
    with pytest.raises(InputError, match=r"record: expected a place to write to, found .*No such file"):
        RecordTable(tmp_path / "nowhere" / "record.csv", [], [])


def test_a_disk_that_is_full_is_said_in_one_line(moving, tmp_path):
    record = RecordTable(tmp_path / "record.csv", ["needle", "patient"], ["mass0"])

    class Full:
        def write(self, text):
            raise OSError(28, "No space left on device")

    record._stream.close()
    record._stream = Full()
    with pytest.raises(InputError, match=r"record: expected .*record\.csv to take more, found it refused: No space left"):
        record.publish(moment(moving, three()))
