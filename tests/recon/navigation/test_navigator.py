"""From devices to moments, with a tracker of a known speed: what is slow loses moments, what is lost comes back."""

from dataclasses import dataclass
from time import monotonic_ns, sleep

import numpy as np
import pytest
import trimesh

from recon.devices.interfaces import DeviceError
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation.feeds import Device
from recon.navigation.mass_distances import bodies_of
from recon.navigation.moving_bodies import MovingBodies
from recon.navigation.navigator import Navigator
from recon.navigation.seen_so_far import SeenSoFar
from recon.tracking.pose_fit import lost
from tests.recon import probe_motions
from tests.recon.navigation.bodies_seen import NEEDLE, PROBE, three, unseen
from tests.recon.navigation.live_stand_ins import Kept, Ticking, until

PERIOD_S = 0.02


@dataclass
class Found:
    """What a tracker gives."""

    pose: object
    how: str | None
    others: tuple = ()

    @property
    def found(self):
        return self.how is not None


@dataclass
class Posed:
    world_from_target: np.ndarray


class Steady:
    """A tracker that finds a target which moves along x by 10 mm/s, unless it is hidden."""

    hidden, seconds = False, 0.0

    def step(self, left, right, time_s):
        sleep(self.seconds)
        if self.hidden:
            return Found(lost("camera 1: 2 of 3 circles"), None)
        return Found(Posed(rigid.transform(np.eye(3), [10 * time_s, 0, 650])), "predicted")


def own_clock(source):
    """The devices here have this computer's."""
    return lambda frame: frame.time_ns


@pytest.fixture
def navigate(rig):
    """Start a navigator of devices that share a clock; all are stopped in the end."""
    running, start = [], monotonic_ns()

    def begin(publishers, tracker=None, opener=lambda name: None, masses=None, **others):
        def device(name):
            return Device(name, lambda: opener(name) or Ticking(start, PERIOD_S), own_clock)

        cam1, cam2, us = map(device, ("cam1", "cam2", "us"))
        probe = probe_motions.true_probe(rig)
        masses = bodies_of(masses or {})
        running.append(Navigator((cam1, cam2), us, tracker or Steady(), probe, 0.01, masses, publishers, 0.05, **others))
        running[-1].start()
        return running[-1]

    yield begin
    for each in running:
        each.stop()


def test_moments_come_with_pose_scan_and_distances(navigate):
    ball = trimesh.creation.icosphere(2, 3.0).apply_translation([0, 0, 700])
    kept = Kept()
    navigate([kept], masses={"mass0": ball})
    until(lambda: sum(moment.scan is not None for moment in kept.moments) >= 5)
    numbers = [moment.number for moment in kept.moments]
    assert numbers == sorted(set(numbers))
    last = kept.moments[-1]
    assert last.world_from_target[0, 3] == pytest.approx(10 * last.exposed_ns * 1e-9)
    assert [each.name for each in last.distances] == ["mass0"]
    along = [moment.scan.world_from_pixel[0, 3] - 10 * moment.scan.taken_ns * 1e-9 for moment in kept.moments if moment.scan]
    np.testing.assert_allclose(along, along[0], atol=1e-6)


def test_a_slow_publisher_shows_the_newest_and_holds_up_no_other(navigate):
    """At 50 moments a second one takes a fifth of a second for each: it shows few, none of them old."""
    fast, slow = Kept("fast"), Kept("slow", 0.2)
    navigator = navigate([fast, slow])
    until(lambda: len(slow.moments) >= 4)
    assert len(fast.moments) > 3 * len(slow.moments) and navigator.outlets[1].newest.replaced > 0
    assert np.diff([moment.number for moment in slow.moments]).min() > 1
    assert navigator.outlets[1].latencies.figures().high_ms < 600, "late by its own work, not by what it hasn't shown"


def test_a_slow_tracker_tracks_the_newest_frames(navigate):
    """A tenth of a second for each pair, of which fifty come a second: none waits for those before it."""
    tracker, kept = Steady(), Kept()
    tracker.seconds = 0.1
    navigator = navigate([kept], tracker)
    until(lambda: len(kept.moments) >= 8)
    assert navigator.pairs.replaced > 8
    assert navigator.outlets[0].latencies.figures().high_ms < 500


def test_a_camera_that_is_lost_comes_back_and_is_told_meanwhile(navigate):
    opened, kept = [], Kept()

    def opener(name):
        if name != "cam2":
            return None
        opened.append(name)
        if len(opened) == 1:
            return Ticking(start, PERIOD_S, lost_after=5)
        if len(opened) < 15:
            raise DeviceError("cam2: expected a camera, found none; plug it in")
        return None

    start = monotonic_ns()
    navigator = navigate([kept], opener=opener)
    until(lambda: any("cam2: expected a camera" in moment.status for moment in kept.moments))
    silent = next(moment for moment in kept.moments if "cam2" in moment.status)
    assert silent.world_from_target is None and silent.scan is None and silent.state == "no frames of both cameras"
    until(lambda: kept.moments[-1].world_from_target is not None and not kept.moments[-1].troubles)
    assert navigator.running and len(opened) == 15


def test_a_scanner_that_is_lost_leaves_tracking_alone_and_no_old_image_in_place(navigate):
    kept = Kept()
    tries = []

    def opener(name):
        if name == "us":
            tries.append(name)
            if len(tries) > 1:
                raise DeviceError("us: expected a scanner, found none")
            return Ticking(monotonic_ns(), PERIOD_S, lost_after=10)
        return None

    navigate([kept], opener=opener)
    until(lambda: any(moment.scan is not None for moment in kept.moments))
    until(lambda: "us: expected a scanner" in kept.moments[-1].status and kept.moments[-1].scan is None)
    assert kept.moments[-1].world_from_target is not None


def test_a_hidden_target_has_a_reason_and_no_pose(navigate):
    tracker, kept = Steady(), Kept()
    tracker.hidden = True
    navigate([kept], tracker)
    until(lambda: len(kept.moments) >= 3)
    assert {moment.state for moment in kept.moments} == {"target not found: camera 1: 2 of 3 circles"}
    assert all(moment.world_from_target is None and moment.scan is None for moment in kept.moments)


def test_an_end_closes_devices_and_publishers(navigate):
    kept, devices = Kept(), []

    def opener(name):
        devices.append(Ticking(monotonic_ns(), PERIOD_S))
        return devices[-1]

    navigator = navigate([kept], opener=opener)
    until(lambda: len(devices) == 3)
    navigator.stop()
    assert kept.closed and all(device.closed for device in devices) and not navigator.running


def test_an_end_closes_the_others_though_one_fails(navigate):
    class Stuck(Kept):
        def close(self):
            if not self.closed:
                super().close()
                raise RuntimeError("a fault in the program")

    publishers = [Kept(), Stuck(), Kept()]
    navigator = navigate(publishers)
    with pytest.raises(RuntimeError):
        navigator.stop()
    assert all(each.closed for each in publishers) and not navigator.running


def test_what_cannot_be_published_is_told_in_one_line(navigate, caplog, monkeypatch):
    class Refusing(Kept):
        def publish(self, moment):
            raise InputError("IMAGE of 'BScan': expected at most 67108864 bytes, found 99999999")

    unhandled = []
    monkeypatch.setattr("threading.excepthook", unhandled.append)
    navigator = navigate([Refusing()])
    until(lambda: not navigator.running)
    assert not unhandled and "kept: IMAGE of 'BScan': expected at most 67108864 bytes" in caplog.text


def test_a_publisher_that_fails_ends_it_all(navigate, monkeypatch):
    """Its fault is printed by its thread; nobody goes on to look at a picture that stands still."""

    class Failing(Kept):
        def publish(self, moment):
            raise RuntimeError("a fault in the program")

    monkeypatch.setattr("threading.excepthook", lambda fault: None)
    navigator = navigate([Failing()])
    until(lambda: not navigator.running)


class Three:
    """A tracker of three bodies at rest, some of which may be hidden."""

    hidden: tuple[str, ...] = ()

    def step(self, left, right, time_s):
        return three(**{name: unseen() for name in self.hidden})


def test_tools_come_with_their_tips_beside_the_b_scan(navigate):
    tip = Tip(np.array([0.0, 5, -150]), np.eye(6) * 1e-4, np.array([0.0, 0, -1]))
    kept, tracker = Kept(), Three()
    navigate([kept], tracker, moving=MovingBodies({"needle": tip}))
    until(lambda: any(moment.scan is not None for moment in kept.moments))
    moment = kept.moments[-1]
    np.testing.assert_allclose(moment.world_from_target, PROBE, atol=1e-9)
    assert [body.name for body in moment.bodies] == ["needle", "patient"]
    np.testing.assert_allclose(moment.bodies[0].figures.tip, rigid.apply(NEEDLE, tip.tip_mm), atol=1e-9)
    assert next(one for one in kept.moments if one.scan is not None).bodies[0].figures.plane is not None
    tracker.hidden = ("probe",)
    until(lambda: kept.moments[-1].world_from_target is None)
    assert kept.moments[-1].places_any and kept.moments[-1].bodies[0].figures is not None, "a tool needs no probe"
    tracker.hidden = ("patient",)
    until(lambda: not kept.moments[-1].places_any and kept.moments[-1].scan is None)
    assert all(body.world_from_body is None and body.figures is None for body in kept.moments[-1].bodies)
    assert kept.moments[-1].state.startswith("patient not found: camera 1: 2 of 3 circles")


def test_a_record_gets_every_moment_however_slow_it_is(navigate):
    """Half as fast as moments come, and yet it misses none; the page beside it is not held up."""
    kept, record = Kept(), Kept("record", 2 * PERIOD_S)
    navigator = navigate([kept], recorders=[record])
    until(lambda: len(record.moments) >= 10)
    navigator.stop()
    numbers = [moment.number for moment in record.moments]
    assert numbers == list(range(1, numbers[-1] + 1)) and numbers[-1] >= kept.moments[-1].number
    assert record.closed and record.moments[-1].frame_ns is not None


def test_b_scans_are_mapped_and_moments_hold_the_newest_map(navigate):
    """Each that is placed, once; also of moments without frames or a pose."""

    class Mapped(Kept):
        newest = SeenSoFar(0.5, 1000.0, np.zeros((1, 3), np.float32), np.zeros(1, np.float32))

        def start(self):
            self.scans = []

        def add(self, scan):
            self.scans.append(scan)

        stop = Kept.close

    kept, mapper = Kept(), Mapped()
    navigator = navigate([kept], mapper=mapper)
    until(lambda: sum(moment.scan is not None for moment in kept.moments) >= 5)
    navigator.stop()
    numbers = [scan.number for scan in mapper.scans]
    assert mapper.closed and len(numbers) >= 5 and len(set(numbers)) == len(numbers)
    assert all(moment.seen is mapper.newest for moment in kept.moments)
