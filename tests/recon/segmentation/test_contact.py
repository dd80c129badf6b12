"""The array's face against the skin: its distance, what that is known to, and what is said where they don't meet."""

import numpy as np
import pytest
import trimesh

from recon.freehand import sequences
from recon.freehand.place_uncertainty import GIVEN_MM, PlaceErrors
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.segmentation import contact
from scenes.solid_meshes import grid

SIZE, SCALE, COUNT = (320, 400), np.array([0.12, 0.12]), 24
DEPTH_MM = 600.0  # of a flat skin before the camera


@pytest.fixture(scope="module")
def skin() -> trimesh.Trimesh:
    """A plane of 80 x 80 mm, a vertex each mm."""
    places, faces = grid((80, 80), (80, 80))
    return trimesh.Trimesh(np.column_stack([places, np.full(len(places), DEPTH_MM)]), faces, process=False)


def sweep(off_mm, covariance=None, errors=None, aside_mm=0.0) -> Scans:
    """B-scans that look down into the skin, their faces off it by so many mm : (n,), one behind the other."""
    known = None if covariance is None else Uncertainty(NAMES, covariance)
    probe = ProbeCalibration(np.eye(4), SCALE, known)
    looking_in = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the depth axis along the camera's
    places = np.column_stack(
        [np.full(COUNT, aside_mm - 19.0), np.linspace(-10, 10, COUNT), DEPTH_MM - np.broadcast_to(off_mm, COUNT)]
    )
    poses = np.stack([rigid.transform(looking_in, place) for place in places])
    return Scans(SIZE[::-1], poses @ sequences.target_from_pixel(probe), lambda: iter(()), 1540, 1540, probe, errors)


def test_distances_are_those_of_the_face(skin):
    """Positive off the skin, negative within; to the mesh's own exactness."""
    off = np.linspace(-0.5, 1.5, COUNT)
    found = contact.measure(sweep(off), skin)
    assert found.distances_mm == pytest.approx(off, abs=1e-6)
    assert found.median_mm == pytest.approx(0.5, abs=1e-6) and np.isnan(found.sigma_mm)


def test_beside_the_skin_it_is_said_to_be_unknown(skin):
    found = contact.measure(sweep(0.0, aside_mm=200.0), skin)
    assert np.isnan(found.distances_mm).all() and not found.figures
    assert found.lines == ["contact     of the array's face with the skin isn't known: over it in 0 B-scans"]


def test_noise_of_the_skin_does_not_press_the_face_into_it(skin, rng):
    """0.1 mm of noise a vertex, of which the least of 45 is 0.2 mm too low: by a third of that at most."""
    rough = skin.copy()
    rough.vertices[:, 2] += 0.1 * rng.standard_normal(len(rough.vertices))
    rough.vertex_normals = np.tile([0.0, 0.0, -1.0], (len(rough.vertices), 1))
    assert abs(contact.measure(sweep(0.0), rough).median_mm) < 0.12


def test_without_a_covariance_there_is_no_alarm(skin):
    """The distance alone: what it is known to isn't."""
    assert len(contact.measure(sweep(-0.4), skin).lines) == 1


def test_sigma_is_what_errs_alike_and_what_averages(skin):
    """A shift of the probe's calibration along the beam, 0.1 mm, and poses of 0.2 mm each that average over 24 of them.

    A shift along the skin moves nothing: closed form.
    """
    along_beam = np.diag([0, 0, 0, 0, 0, 1.0, 0.1, 1.0]) ** 2  # sx sy, a turn, a shift in the target's axes: depth is y
    nothing = np.zeros((COUNT, 6, 6))
    own = np.tile(np.diag([0, 0, 0, 0.2, 0.2, 0.2]) ** 2, (COUNT, 1, 1))
    errors = PlaceErrors(own, np.eye(COUNT), nothing, np.zeros((COUNT, 4, 4)))
    found = contact.measure(sweep(0.0, along_beam, errors), skin)
    assert found.sigma_mm == pytest.approx(np.linalg.norm([0.1, 0.2 / np.sqrt(COUNT), GIVEN_MM]), rel=1e-6)


def test_the_latency_shows_where_the_probe_moves_along_its_beam(skin):
    """5 mm/s and 10 ms are 0.05 mm, beside what a bracket gives."""
    rates = np.zeros((COUNT, 4, 4))
    rates[:, 2, 3] = 5.0
    nothing = np.zeros((COUNT, 6, 6))
    errors = PlaceErrors(nothing, np.eye(COUNT), nothing, rates, lag_s=0.01)
    found = contact.measure(sweep(0.0, np.zeros((8, 8)), errors), skin)
    assert found.sigma_mm == pytest.approx(np.hypot(0.05, GIVEN_MM), rel=1e-6)


@pytest.mark.parametrize(("off_mm", "said"), [(-0.4, "within the measured skin"), (0.0, ""), (0.8, ""), (1.6, "doesn't reach")])
def test_a_face_that_does_not_meet_the_skin_is_said(skin, off_mm, said):
    """Known to 0.1 mm: pressed by 0.4 mm, in touch, through a layer of gel, and above it."""
    covariance = np.diag([0, 0, 0, 0, 0, 0, 0.1, 0]) ** 2
    lines = contact.measure(sweep(off_mm, covariance), skin).lines
    assert len(lines) == 1 + bool(said)
    assert not said or (lines[1].startswith("warning") and said in lines[1] and "pressed" in lines[1])
