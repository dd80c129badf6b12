"""Moments by the OpenIGTLink server: a client that connects late gets the scene and the newest moment."""

import numpy as np
import trimesh

from recon.devices.openigtlink.igtl_client import Client
from recon.devices.openigtlink.igtl_server import LOOPBACK, Server
from recon.freehand import sequences
from recon.geometry import rigid
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import Moment, StillScene
from recon.navigation.slicer_publisher import IgtlSender, SlicerPublisher
from tests.recon import probe_motions

POSE = rigid.from_rotation_vector([2.8, 0.3, -0.4], [30, -12, 655])


def test_a_client_gets_all_of_a_moment(rig):
    probe, server = probe_motions.true_probe(rig), Server(LOOPBACK, 0)
    skin = trimesh.creation.icosphere(2, 50.0).apply_translation([0, 0, 700])
    publisher = SlicerPublisher(StillScene(probe.target_from_image, skin, {"mass0": skin}, skin), IgtlSender(server))
    scan = PlacedScan(np.arange(20, dtype=np.uint8).reshape(4, 5), 1, 10**9, POSE @ sequences.target_from_pixel(probe))
    publisher.publish(Moment(1, 10**9, POSE, "target predicted", scan))
    client = Client(LOOPBACK, server.port)
    try:
        names = {"TargetToRAS", "ProbeToRAS", "BScan", "Skin", "Mass0", "Probe", "Status", "Distances"}
        received = [client.receive(5.0) for _ in names]
    finally:
        client.close()
        publisher.close()
    found = {each.message.device: each.message.content for each in received}
    assert found.keys() == names
    image = found["BScan"]
    np.testing.assert_array_equal(image.plane, scan.image)
    np.testing.assert_allclose(image.ras_from_index[:, :2], (sequences.RAS_FROM_LPS @ scan.world_from_pixel)[:, :2], atol=1e-6)
    np.testing.assert_allclose(image.ras_from_index[:3, 3], (sequences.RAS_FROM_LPS @ scan.world_from_pixel)[:3, 3], atol=1e-4)
    np.testing.assert_allclose(found["Skin"].points.mean(axis=0), [0, 0, 700], atol=1e-3)
    np.testing.assert_array_equal(found["Skin"].triangles, skin.faces)
