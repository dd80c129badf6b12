"""Each picture comes with where the skin was in it: carried by the patient's target, or where it was measured."""

from time import monotonic_ns
from types import SimpleNamespace

import numpy as np

from recon.geometry import rigid
from recon.mentoring.sightings import Sightings, by_patient
from recon.model.rig import PATIENT
from recon.navigation.feeds import Arrival, Device
from recon.navigation.frame_pairs import FramePair
from tests.recon.navigation.live_stand_ins import Ticking, until

FIRST = rigid.from_rotation_vector([0.1, 2.9, 0.2], [-100.0, -20.0, 660.0])  # of the target, when the skin was measured
MOVED = rigid.from_rotation_vector([0.02, 0.03, -0.1], [5.0, 1.0, -2.0])  # of the patient since
BESIDE = rigid.from_rotation_vector([0.3, 0, 0], [0.0, 0, 5.0])


class Bodies:
    """A tracker that is told where the patient's target is, beside others."""

    def __init__(self, *poses):
        self.poses = list(poses)

    def step(self, left, right, time_s):
        pose = self.poses.pop(0)
        found = SimpleNamespace(found=pose is not None, pose=SimpleNamespace(world_from_target=pose, reason="covered circles"))
        return {"probe": SimpleNamespace(found=False), PATIENT: found}


def pair():
    frame = SimpleNamespace(image=np.zeros((4, 4), np.uint8))
    return FramePair(Arrival(frame, 5), Arrival(frame, 6))


def test_a_point_of_the_skin_moves_with_the_patient():
    follow = by_patient(Bodies(MOVED @ FIRST), FIRST)
    place, reason = follow(pair())
    np.testing.assert_allclose(place, MOVED, atol=1e-9)
    assert reason == ""


def test_without_a_reference_the_first_pose_is_one():
    follow = by_patient(Bodies(None, FIRST, MOVED @ FIRST), None)
    assert follow(pair()) == (None, f"the {PATIENT} isn't found: covered circles")
    np.testing.assert_allclose(follow(pair())[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(follow(pair())[0], MOVED, atol=1e-9)


def run(cameras, follow, enough):
    """Sightings until there are enough of them."""
    came = []
    sightings = Sightings(cameras, follow, came.append, again_s=0.05)
    sightings.start()
    until(lambda: enough(came))
    assert sightings.running
    sightings.stop()
    return came


def device(name, **others):
    start = monotonic_ns()
    return Device(name, lambda: Ticking(start, **others), lambda source: lambda frame: frame.time_ns)


def test_camera_1_alone_is_enough_for_a_skin_that_is_not_followed():
    came = run([device("cam1")], None, lambda came: len(came) > 4)
    assert all((one.world_from_skin == np.eye(4)).all() and one.image is not None for one in came if one.reason == "")
    numbers = [one.number for one in came]
    assert numbers == list(range(1, len(came) + 1))


def test_frames_of_both_cameras_are_followed_in_pairs():
    start = monotonic_ns()
    cameras = [Device(name, lambda: Ticking(start), lambda source: lambda frame: frame.time_ns) for name in ("cam1", "cam2")]
    came = run(cameras, lambda both: (MOVED, ""), lambda came: sum(one.image is not None for one in came) > 3)
    assert all((one.world_from_skin == MOVED).all() for one in came if one.image is not None)


def test_a_lost_camera_is_told_as_the_reason():
    came = run(
        [device("cam1", lost_after=0)], None, lambda came: any(one.image is None and "unplugged" in one.reason for one in came)
    )
    assert all(one.world_from_skin is None for one in came if one.image is None)
