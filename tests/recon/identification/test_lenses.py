"""Blur over depth: is a lens's point spread, aperture and focus what the edges of a board's discs say, within their sigma?"""

import numpy as np
import pytest
from scipy import stats

from recon.board_detection.discs import measure
from recon.geometry.ellipses import Ellipses
from recon.identification.estimates import Estimate, Findings
from recon.identification.lenses import Rims, find_lens, fitted_width, focused_on, joined, measure_rims, widths
from recon.model.calibration import Calibration
from recon.model.rig import Measured
from tests.recon.identification import lit_boards
from tests.recon.identification.exact_discs import SIDE, share

FOCAL_PX, FOCAL_MM, DISC_MM = 1660.0, 16.0, 4.5  # the disc's radius
ENGRAVED = Estimate(FOCAL_MM, 0.0, "engraved")
FIELDS = ("f_number", "focus_mm", "blur_px")


def rims_of_tiles(tiles, centres, radii):
    """Widths, their sigma, and reach, of dark discs in a row of tiles."""
    image = np.concatenate(tiles, axis=1)
    at = np.array(centres) + np.column_stack([SIDE * np.arange(len(tiles)), np.zeros(len(tiles))])
    room = 0.45 * radii
    found = measure(image, Ellipses(np.rint(at), radii[:, None, None] * np.eye(2)), room)
    reach = np.minimum(room, 4 + 6 * found.edges.blur)
    return *widths(found, reach), reach


def edges(rng, depth, aperture, focus, blur, noise, print_mm=0.0, disc_mm=DISC_MM):
    """Rims of discs at depths, as measured in exact images of them."""
    disc = aperture * FOCAL_PX * np.abs(1 / focus - 1 / depth)
    radii, centres, tiles = FOCAL_PX * disc_mm / depth, rng.uniform(23, 24, (len(depth), 2)), []
    for k in range(len(depth)):
        axes, turn = radii[k] * np.array([1.05, 1 / 1.05]), rng.uniform(0, np.pi)
        black = share(centres[k], axes, turn, blur, disc[k], print_mm * FOCAL_PX / depth[k])
        tiles.append(np.rint(180 - 140 * black + rng.normal(0, noise, black.shape)))
    width, sigma, reach = rims_of_tiles(tiles, centres, radii)
    flat = np.zeros(len(depth))
    pose = np.arange(len(depth)) * 8 // len(depth)
    return Rims(width, sigma, reach, radii, depth, flat, flat + FOCAL_PX, rng.uniform(-0.7, 0.7, (len(depth), 2)), pose)


def scored(findings, truth):
    """z of each field that was found."""
    return {
        field: (found.value - true) / found.sigma
        for field, true in zip(FIELDS, truth, strict=True)
        if (found := findings.estimates.get(f"cam1.lens.{field}"))
    }


@pytest.mark.parametrize(("blur", "disc"), [(0.15, 0.0), (0.3, 0.0), (0.45, 1.0), (0.3, 2.0), (0.9, 3.0)])
@pytest.mark.parametrize("radius", [9.0, 16.0])
def test_the_width_of_a_disc_s_edge_is_predicted(rng, blur, disc, radius):
    """To 5e-4 px, where the plain standard deviation is off by up to 0.05 px."""
    centres = rng.uniform(23, 24, (8, 2))
    tiles = [180 - 140 * share(c, (1.06 * radius, radius / 1.06), rng.uniform(0, np.pi), blur, disc) for c in centres]
    width, _, reach = rims_of_tiles(tiles, centres, np.full(8, radius))
    expected = fitted_width(np.full(8, blur**2), np.full(8, disc), reach).width
    curved = expected * (1 + (expected / radius) ** 2 / 4)
    assert np.abs((width - curved).mean()) < 5e-4 + 2e-3 * (disc > 2 and radius < 10)


@pytest.mark.parametrize(("blur", "disc", "noise"), [(0.3, 0.0, 4.0), (0.45, 1.0, 8.0), (0.8, 2.0, 8.0)])
def test_widths_scatter_as_predicted_and_noise_does_not_bend_them(rng, blur, disc, noise):
    """The sectors' offsets follow the noise, which takes 0.003 px off the width at 8 DN: four standard errors here."""
    centres = np.tile(rng.uniform(23, 24, (8, 2)), (50, 1))
    radii, tiles = np.full(len(centres), 11.0), [180 - 140 * share(c, (11, 11), 0, blur, disc) for c in centres[:8]] * 50
    clean, _, _ = rims_of_tiles(tiles, centres, radii)
    width, sigma, _ = rims_of_tiles([t + rng.normal(0, noise, t.shape) for t in tiles], centres, radii)
    z = (width - clean) / sigma
    assert z.std() == pytest.approx(1, abs=0.12)
    assert abs(z.mean()) < 3 / np.sqrt(len(z))


@pytest.mark.parametrize(("blur", "disc_mm"), [(0.5, 4.5), (0.9, 2.5)])
def test_a_lens_is_found_by_its_blur(rng, blur, disc_mm):
    """Of small discs, too, whose edges are curved within the blur."""
    truth, depths = (5.6, 640.0, blur), rng.uniform(560, 760, 96)
    rims = edges(rng, depths, FOCAL_MM / 5.6, 640.0, blur, 1.0, disc_mm=disc_mm)
    found = find_lens(rims, focal_length=ENGRAVED, print_mm=0)
    z = scored(found, truth)
    assert set(z) == set(FIELDS) and max(map(abs, z.values())) < 3
    assert found.estimates["cam1.lens.f_number"].sigma < 0.3


@pytest.mark.slow
def test_intervals_cover_the_lens(rng):
    """Of 12 lenses the intervals of 95 % hold in 99.9 % of drawings as often as asked; all three fields together closer."""
    z = {field: [] for field in FIELDS}
    for _ in range(12):
        number, focus, blur = rng.uniform(4, 11), rng.uniform(450, 900), rng.uniform(0.3, 0.9)
        rims = edges(rng, rng.uniform(560, 760, 96), FOCAL_MM / number, focus, blur, 2.0)
        for field, value in scored(find_lens(rims, focal_length=ENGRAVED, print_mm=0), (number, focus, blur)).items():
            z[field].append(value)
    for values in z.values():
        assert len(values) > 7
        assert held(values)
        assert np.std(values) == pytest.approx(1, abs=0.5)  # 2.5 standard deviations of 12 draws
    assert held(np.concatenate(list(z.values())))


def held(values) -> bool:
    """Whether intervals of 95 % hold as often as they would in 999 of 1000 drawings."""
    return np.count_nonzero(np.abs(values) < 1.96) >= stats.binom.ppf(0.001, len(values), 0.95)


def test_one_depth_does_not_tell_the_aperture(rng):
    found = find_lens(edges(rng, rng.uniform(649, 651, 80), 2.0, 800.0, 0.5, 2.0), focal_length=ENGRAVED)
    assert not found.estimates
    assert "don't part the aperture from the focus" in found.unknown["cam1.lens.f_number"]


def test_without_a_focal_length_in_mm_the_pupil_is_known(rng):
    found = find_lens(edges(rng, rng.uniform(560, 760, 80), 2.0, 650.0, 0.5, 2.0))
    assert "entrance pupil is 1.9" in found.unknown["cam1.lens.f_number"] or "2.0" in found.unknown["cam1.lens.f_number"]
    assert "cam1.lens.focus_mm" in found.estimates


def test_a_soft_print_passes_for_a_point_spread_within_its_sigma(rng):
    """Edges of 0.03 mm: 0.075 px, which 0.4 px of blur would be taken for 0.41, many times the noise."""
    found = find_lens(edges(rng, rng.uniform(560, 760, 96), 2.5, 650.0, 0.4, 1.0, print_mm=0.03), print_mm=0.02)
    sure = find_lens(edges(rng, rng.uniform(560, 760, 96), 2.5, 650.0, 0.4, 1.0, print_mm=0.03), print_mm=0)
    assert abs(scored(found, (0, 650.0, 0.4))["blur_px"]) < 3
    assert scored(sure, (0, 650.0, 0.4))["blur_px"] > 3


def test_a_point_spread_that_varies_over_the_image_counts_to_sigma(rng):
    rims = edges(rng, rng.uniform(560, 760, 96), 2.5, 650.0, 0.5, 1.0)
    softer = np.sqrt(rims.width**2 + 0.1 * (rims.place**2).sum(axis=1))
    even = find_lens(rims).estimates["cam1.lens.blur_px"]
    varied = find_lens(Rims(softer, *(getattr(rims, name) for name in list(rims.__dataclass_fields__)[1:])))
    found = varied.estimates["cam1.lens.blur_px"]
    assert found.sigma > 2 * even.sigma and "varying by 0.0" in found.source


@pytest.mark.slow
def test_the_twin_s_lens_is_found(rig, rng):
    """A rendered board in six poses; each estimate within 3.5 sigma."""
    rig = lit_boards.drawn(rig, rng)
    session = lit_boards.shot(rig, 6)
    rims = joined([
        measure_rims(image, session.board, session.camera, pose, pose=k)
        for k, (image, pose) in enumerate(zip(session.images, session.poses, strict=True))
    ])  # fmt: skip
    lens = rig.cam1.lens
    found = find_lens(rims, focal_length=Estimate(lens.focal_length_mm, 0.0, "engraved"), print_mm=0)
    z = scored(found, (lens.f_number, lens.focus_mm, lens.blur_px))
    assert "blur_px" in z and max(map(abs, z.values())) < 3.5


@pytest.mark.parametrize(
    ("away_mm", "measured", "moves"), [(3600, False, True), (3600, True, False), (700, False, False), (350, False, True)]
)
def test_a_focus_of_another_rig_is_taken_from_where_the_board_stood(rig, away_mm, measured, moves):
    """From boards at 3500 to 3700 mm, say, before a rig that is focused at 660 mm; not what was measured, nor what is near."""
    name = "cam1.lens.focus_mm"
    known = rig.model_copy(update={"measured": {name: Measured(sigma=1.0, source="a test")} if measured else {}})
    boards = [np.array([[0.0, 0.0, away_mm + side]]) for side in (-100, 0, 100)]
    found, said = focused_on(known, Calibration({"cam1": rig.cam1.optics.camera()}), boards, Findings())
    assert found.cam1.lens.focus_mm == (away_mm if moves else rig.cam1.lens.focus_mm) and len(said) == moves
    assert found.projector == rig.projector and all(f"{away_mm - 100} to {away_mm + 100} mm" in line for line in said)
