"""The array's face against the skin: its distance, what that is known to, and what is said where they don't meet."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter1d

from recon.freehand import sequences
from recon.freehand.place_uncertainty import PlaceErrors
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
    assert found.sigma_mm == pytest.approx(np.linalg.norm([0.1, 0.2 / np.sqrt(COUNT), contact.LIMITS.given_mm]), rel=1e-6)


def test_the_latency_shows_where_the_probe_moves_along_its_beam(skin):
    """5 mm/s and 10 ms are 0.05 mm, beside what a bracket gives."""
    rates = np.zeros((COUNT, 4, 4))
    rates[:, 2, 3] = 5.0
    nothing = np.zeros((COUNT, 6, 6))
    errors = PlaceErrors(nothing, np.eye(COUNT), nothing, rates, lag_s=0.01)
    found = contact.measure(sweep(0.0, np.zeros((8, 8)), errors), skin)
    assert found.sigma_mm == pytest.approx(np.hypot(0.05, contact.LIMITS.given_mm), rel=1e-6)


@pytest.mark.parametrize(("off_mm", "said"), [(-0.4, "within the measured skin"), (0.0, ""), (0.8, ""), (1.6, "doesn't reach")])
def test_a_face_that_does_not_meet_the_skin_is_said(skin, off_mm, said):
    """Known to 0.1 mm: pressed by 0.4 mm, in touch, through a layer of gel, and above it."""
    covariance = np.diag([0, 0, 0, 0, 0, 0, 0.1, 0]) ** 2
    lines = contact.measure(sweep(off_mm, covariance), skin).lines
    assert len(lines) == 1 + bool(said)
    assert not said or (lines[1].startswith("warning") and said in lines[1] and "pressed" in lines[1])


RADIUS_MM = 60.0  # of a round skin, its top where the flat one is
KNOWN = np.diag([0, 0, 0, 0, 0, 0, 0.07, 0]) ** 2  # covariance of a probe's calibration, along the beam


def over_dome(rng, motion_mm=(0.0, 0.0, 0.0), hidden=slice(0, 0)) -> contact.Contact:
    """Contact along two strokes over a dome that moves after light has measured it, by a hand a third as unsteady as the twin's.

    hidden : B-scans over a thing of 16 mm that lay on the skin under the fringes
    """
    places, faces = grid((120, 120), (60, 60))
    vertices = np.column_stack([places, DEPTH_MM + RADIUS_MM - np.sqrt(RADIUS_MM**2 - np.sum(places**2, axis=1) / 2)])
    middle = np.array([0, 0, DEPTH_MM + RADIUS_MM])
    vertices = middle + RADIUS_MM * (vertices - middle) / np.linalg.norm(vertices - middle, axis=1)[:, None]
    along = np.concatenate([np.linspace(-34, 34, 67), np.linspace(34, -34, 67)])
    aside = np.repeat([-22.0, 22.0], 67)
    down = np.column_stack([-aside, -along, np.sqrt(RADIUS_MM**2 - aside**2 - along**2)]) / RADIUS_MM
    hand = gaussian_filter1d(rng.standard_normal(334), 3)[100:-100] * 0.16 + 0.05 * rng.standard_normal(134)  # 0.05 mm each
    across = np.cross(np.cross(down, [1.0, 0, 0]), down)
    across *= np.sign(across[:, :1]) / np.linalg.norm(across, axis=1)[:, None]
    turns = np.stack([across, down, np.cross(across, down)], axis=2)
    touched = middle + motion_mm - (RADIUS_MM + hand)[:, None] * down
    probe = ProbeCalibration(np.eye(4), SCALE, Uncertainty(NAMES, KNOWN))
    poses = np.stack([rigid.transform(turn, place - 19.2 * turn[:, 0]) for turn, place in zip(turns, touched, strict=True)])
    measured = trimesh.Trimesh(vertices, faces, process=False)
    if hidden.stop:
        lain = np.abs(vertices - touched[hidden].mean(axis=0))[:, :2].max(axis=1) < 8
        measured.vertices[lain] -= [0, 0, 16]
    scans = Scans(SIZE[::-1], poses @ sequences.target_from_pixel(probe), lambda: iter(()), 1540, 1540, probe, None)
    return contact.measure(scans, measured)


def test_a_motion_along_the_beam_is_told_from_gel_by_nothing(rng):
    """0.5 mm towards the probe: a distance within gel, of which the line says both causes."""
    found = over_dome(rng, (0.0, 0.0, -0.5))
    assert 0.35 < found.median_mm < 0.6
    assert "gel, or a skin that has risen" in found.lines[0] and not any("warning" in line for line in found.lines)


def test_a_thing_that_lay_on_the_skin_is_said(rng):
    """A finger in the measured skin, under eight of 134 B-scans: the median doesn't go with it. One bad pose is no finger."""
    found = over_dome(rng, hidden=slice(20, 28))
    assert 4 <= found.foreign <= 30 and abs(found.median_mm) < 0.15
    assert any("hand or a cloth" in line for line in found.lines)
    assert not any("hand or a cloth" in line for line in contact.Contact(np.append(np.zeros(199), -3.2), 0.07).lines)
