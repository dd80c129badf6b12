"""Light where the skin is, at once; dark as soon as that isn't known for long, with the reason."""

import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.geometry import rigid
from recon.mentoring.drawings import Drawing, Drawings
from recon.mentoring.sightings import Sighting
from recon.mentoring.skin_light import SkinLight
from recon.skin_projection import skin_curve
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.live_picture import LivePicture, Strips
from recon.skin_projection.projector_image import Line
from tests.recon.mentoring import desk
from tests.recon.navigation.live_stand_ins import until
from tests.recon.skin_projection import skin_shapes

MS = 1_000_000


class Wall:
    """A projector that keeps what it shows."""

    def __init__(self):
        self.shown, self.gone = [], False

    def show(self, pattern):
        if self.gone:
            raise DeviceError("projector: expected its display, found it gone")
        self.shown.append(pattern)

    @property
    def lit(self):
        """Middle of the light : (u, v) px; None of a dark picture."""
        v, u = np.nonzero(self.shown[-1])
        return None if len(u) == 0 else np.array([u.mean(), v.mean()])


class Clock:
    def __init__(self):
        self.now_ms = 0

    def __call__(self):
        return self.now_ms * MS


def line(y=0.0):
    chain = skin_curve.evenly([[-10.0, y], [10.0, y]])
    return skin_curve.laid("line", "stroke", chain, Sight.along([0, 0, 1], [0, 0, 600]), skin_shapes.plane())


@pytest.fixture
def light():
    picture = LivePicture(skin_shapes.plane(), skin_shapes.projector())
    return SkinLight(picture, Strips.of(line(), Line(1.0)), Drawings(), Wall(), hold_s=0.5, clock=Clock())


def test_light_follows_the_skin(light):
    projector = skin_shapes.projector()
    for number, x in enumerate((0.0, 5.0, 12.0), start=1):
        light.clock.now_ms += 33
        light.step(desk.sighting(number * 33, rigid.transform(np.eye(3), [x, 0, 0])))
        expected = projector.project([x, 0.0, skin_shapes.PLANE_MM])
        assert light.state.lit and light.state.words == "lit"
        np.testing.assert_allclose(light.projector.lit, expected, atol=1)
    assert light.pictures == len(light.projector.shown) == 3


def test_it_goes_dark_when_the_patient_is_lost_and_says_why(light):
    light.step(desk.sighting(0))
    place = light.projector.lit
    light.clock.now_ms = 400
    light.step(desk.lost(400))
    assert light.state.lit and light.state.words == "lit where the patient was 0.4 s ago: the patient isn't found: no circles"
    light.clock.now_ms = 501
    light.step(None)  # nothing new needs to come
    assert light.state == (False, "dark for 0.5 s: the patient isn't found: no circles") and light.projector.lit is None
    light.clock.now_ms = 9000
    light.step(desk.lost(9000))
    assert light.projector.lit is None and light.state.words.startswith("dark for 9.0 s")
    light.step(desk.sighting(9000))
    assert light.state.lit and (light.projector.lit == place).all()


def test_frames_that_stop_or_come_late_are_no_place_to_light(light):
    light.step(desk.sighting(0))
    light.clock.now_ms = 700
    light.step(None)
    assert light.state == (False, "dark for 0.7 s: frames come late") and light.projector.lit is None
    light.step(desk.sighting(100))  # 0.6 s old when it comes
    assert not light.state.lit and light.projector.lit is None


def test_nothing_is_lit_before_the_patient_is_seen(light):
    assert not light.state.lit
    light.step(desk.lost(1, "no frames"))
    assert light.state == (False, "dark: no frames") and light.projector.lit is None


def test_a_skin_that_is_not_followed_stays_lit(light):
    """A camera that is silent is told; what doesn't change isn't drawn again, but shown, so that a lost display is noticed."""
    light.hold_s = None
    light.step(desk.sighting(0))
    light.clock.now_ms = 60_000
    light.step(Sighting(2, 50_000 * MS, None, None, "cam1: no frame"))
    assert light.state == (True, "lit where the skin was measured; no picture of camera 1 for 10 s")
    assert light.projector.lit is not None and light.pictures == 1 and len(light.projector.shown) == 2


def test_a_drawing_is_lit_at_once_and_taken_back(light):
    light.step(desk.sighting(0))
    alone = np.count_nonzero(light.projector.shown[-1])
    light.drawings.add(Drawing(0, "anna", 0, "", Line(1.0), line(20.0)))
    light.step(None)
    assert np.count_nonzero(light.projector.shown[-1]) == pytest.approx(2 * alone, rel=0.1)
    light.drawings.remove([0])
    light.step(None)
    assert np.count_nonzero(light.projector.shown[-1]) == alone


def test_a_display_that_is_gone_ends_it_with_its_fault(light):
    light.projector.gone = True
    light.start()
    light.sightings.put(desk.sighting(0))
    until(lambda: not light.alive)
    light.stop()
    assert "found it gone" in str(light.fault)


def test_it_ends_dark(light):
    light.start()
    light.sightings.put(desk.sighting(0))
    until(lambda: light.projector.shown and light.projector.lit is not None)
    light.stop()
    assert light.projector.lit is None and light.fault is None
