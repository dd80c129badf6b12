"""What 3D Slicer gets lies in its frame where the files that we write for it lie."""

import dataclasses

import numpy as np
import pytest
import trimesh

from recon.freehand import sequences
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation import slicer_publisher
from recon.navigation.mass_distances import MassDistance
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import BodyAt, Moment, StillScene
from recon.navigation.slicer_publisher import SlicerPublisher
from tests.recon import probe_motions

POSE = rigid.from_rotation_vector([2.8, 0.3, -0.4], [30, -12, 655])


class Sent:
    """A sender that keeps all that it is given, by kind and name."""

    def __init__(self):
        self.messages, self.closed = [], False

    def transform(self, name, ras_from_frame, time_ns):
        self.messages.append(("transform", name, ras_from_frame, time_ns))

    def image(self, name, levels, ras_from_index, time_ns):
        self.messages.append(("image", name, (levels, ras_from_index), time_ns))

    def model(self, name, points, triangles):
        self.messages.append(("model", name, (points, triangles), 0))

    def text(self, name, text, time_ns):
        self.messages.append(("text", name, text, time_ns))

    def close(self):
        self.closed = True

    def of(self, name):
        return [message[2] for message in self.messages if message[1] == name]


@pytest.fixture
def scene(rig):
    probe = probe_motions.true_probe(rig)
    ball = trimesh.creation.icosphere(1, 5.0).apply_translation([1, 2, 700])
    return StillScene(probe.target_from_image, ball, {"mass0": ball}, ball)


def moment_of(probe, number=1):
    image = np.arange(20, dtype=np.uint8).reshape(4, 5)
    scan = PlacedScan(image, number, 10**9, POSE @ sequences.target_from_pixel(probe))
    distance = MassDistance("mass0", -1.25, 3.0, np.empty((0, 2, 3)), True)
    return Moment(number, 10**9, POSE, "target predicted", scan, (distance,))


def test_images_and_transforms_lie_where_a_sequence_of_ours_lies(rig, scene):
    probe, sent = probe_motions.true_probe(rig), Sent()
    moment = moment_of(probe)
    SlicerPublisher(scene, sent).publish(moment)
    written = sequences.sequence_of(moment.scan.image[None], POSE[None], probe, [0.0])
    levels, ras_from_index = sent.of(slicer_publisher.SCAN)[0]
    np.testing.assert_allclose(ras_from_index, written.transforms["ImageToPhysical"][0], atol=1e-12)
    np.testing.assert_array_equal(levels, moment.scan.image)
    (ras_from_target,), (ras_from_image,) = sent.of(slicer_publisher.TARGET), sent.of(slicer_publisher.PROBE)
    np.testing.assert_allclose(ras_from_target, written.transforms["ReferenceToRAS"][0] @ POSE, atol=1e-12)
    corner = rigid.apply(ras_from_image, [4 * probe.scale[0], 3 * probe.scale[1], 0])
    np.testing.assert_allclose(corner, rigid.apply(ras_from_index, [4, 3, 0]), atol=1e-9)


def test_models_lie_in_the_same_frame_and_the_probe_in_the_targets(scene):
    sent = Sent()
    SlicerPublisher(scene, sent)
    for name, expected in (("Skin", [-1, -2, 700]), ("Mass0", [-1, -2, 700]), ("Probe", [1, 2, 700])):
        ((points, triangles),) = sent.of(name)
        np.testing.assert_allclose(points.mean(axis=0), expected, atol=1e-9)
        assert triangles.max() == len(points) - 1


def test_names_of_masses_stay_distinct_and_fit_in_a_message(scene, caplog):
    """Bodies of the same names beside them are kept, and so is each mass."""
    long = ["mass_of_the_left_upper_1", "mass_of_the_left_upper_2", "Knötchen_im_Gewebe_1"]
    names = [*long, "mASS", "MASS", "skin", "probe", "\udcff"]
    ball = scene.skin
    sent, masses = Sent(), dict.fromkeys(names, ball)
    SlicerPublisher(StillScene(scene.target_from_image, ball, masses, ball), sent)
    found = [name for kind, name, *_ in sent.messages if kind == "model"]
    assert len(set(found)) == len(names) + 2 and {"Skin", "Probe", "MASS", "MASS~2", "Skin~2", "Probe~2"} <= set(found)
    assert max(len(name.encode()) for name in found) <= 20
    assert "mass_of_the_left_upper_2 is sent as Mass_of_the_left_u~2" in caplog.text and "MASS is sent as MASS~2" in caplog.text


def test_what_has_not_changed_is_not_sent_again(rig, scene):
    sent = Sent()
    publisher, moment = SlicerPublisher(scene, sent), moment_of(probe_motions.true_probe(rig))
    for _ in range(3):
        publisher.publish(moment)
    assert len(sent.of(slicer_publisher.TARGET)) == 3
    assert len(sent.of(slicer_publisher.SCAN)) == 1
    assert sent.of(slicer_publisher.STATUS) == ["target predicted"]
    assert sent.of(slicer_publisher.DISTANCES) == ["mass0 -1.2 mm, cut"]
    publisher.close()
    assert sent.closed


def test_a_lost_target_sends_no_pose_but_says_why(scene):
    sent = Sent()
    SlicerPublisher(scene, sent).publish(Moment(1, 5, None, "target not found", troubles=("cam2: unplugged",)))
    assert not sent.of(slicer_publisher.TARGET) and not sent.of(slicer_publisher.SCAN)
    assert sent.of(slicer_publisher.STATUS) == ["target not found; cam2: unplugged"]


TIP = Tip(np.array([4.0, 5, -150]), np.eye(6), np.array([0.6, 0.0, -0.8]))
NEEDLE = rigid.from_rotation_vector([3.0, -0.2, 0.5], [-60, 20, 640])


def with_needle(scene, tip=TIP):
    return dataclasses.replace(scene, tools={"needle": tip})


def test_bodies_and_tips_are_sent_by_the_names_of_plus(scene):
    """`NeedleTipToRAS`: the origin at the tip, z along the shaft, x as near to the body's as can be."""
    sent = Sent()
    bodies = (BodyAt("needle", "predicted", NEEDLE), BodyAt("patient", "predicted", POSE))
    SlicerPublisher(with_needle(scene), sent).publish(Moment(1, 5, None, "target not found", bodies=bodies))
    assert {name for kind, name, *_ in sent.messages if kind == "transform"} == {"NeedleToRAS", "NeedleTipToRAS", "PatientToRAS"}
    (ras_from_body,), (ras_from_tip,) = sent.of("NeedleToRAS"), sent.of("NeedleTipToRAS")
    flip = np.diag([-1.0, -1, 1, 1])
    np.testing.assert_allclose(ras_from_body, flip @ NEEDLE, atol=1e-12)
    np.testing.assert_allclose(ras_from_tip[:3, 3], rigid.apply(flip @ NEEDLE, TIP.tip_mm), atol=1e-9)
    np.testing.assert_allclose(ras_from_tip[:3, 2], rigid.rotate(flip @ NEEDLE, TIP.axis), atol=1e-12)
    assert rigid.fault(ras_from_tip) is None
    x = rigid.rotate(np.linalg.inv(flip @ NEEDLE), ras_from_tip[:3, 0])
    np.testing.assert_allclose(x, [0.8, 0, 0.6], atol=1e-12)  # in the plane of shaft and x, across the shaft
    assert sent.of("Tools") == ["needle: seen, no figures"]


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [-1.0, 0, 0], None])
def test_a_tips_frame_is_one_of_any_shaft(axis):
    tip = Tip(TIP.tip_mm, np.eye(6), None if axis is None else np.array(axis))
    found = slicer_publisher.body_from_tip(tip)
    assert rigid.fault(found, 1e-9) is None
    np.testing.assert_allclose(found[:3, 2], [0, 0, 1] if axis is None else axis, atol=1e-12)


def test_a_tool_that_is_not_seen_sends_no_pose_but_says_so(scene):
    sent = Sent()
    lost = BodyAt("needle", "not found: camera 1: 2 of 3 circles")
    SlicerPublisher(with_needle(scene), sent).publish(Moment(1, 5, None, "target not found", bodies=(lost,)))
    assert not sent.of("NeedleToRAS") and not sent.of("NeedleTipToRAS")
    assert sent.of("Tools") == ["needle: not seen: camera 1: 2 of 3 circles"]


def test_names_of_bodies_stay_distinct_and_fit_in_a_message(scene):
    sent = Sent()
    names = ["target", "biopsy_needle_left", "biopsy_needle_right"]
    bodies = tuple(BodyAt(name, "predicted", NEEDLE) for name in names)
    tools = dataclasses.replace(scene, tools=dict.fromkeys(names, TIP))
    SlicerPublisher(tools, sent).publish(Moment(1, 5, POSE, "target predicted", bodies=bodies))
    found = [name for kind, name, *_ in sent.messages if kind == "transform"]
    assert len(set(found)) == len(found) == 2 + 2 * len(names) and max(map(len, found)) <= 20
    np.testing.assert_allclose(sent.of("TargetToRAS")[0], np.diag([-1.0, -1, 1, 1]) @ POSE)
