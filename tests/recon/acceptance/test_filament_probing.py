"""Filaments in drawn B-scans, whose places and widths are known, and in rendered ones, whose pulse is."""

import numpy as np
import pytest
from scipy import stats

from recon.acceptance import optical_acceptance
from recon.acceptance.certificates import Artefacts, FilamentCertificate, Screen
from recon.acceptance.conformity import Limits
from recon.acceptance.filament_probing import Seen, probe_filaments
from recon.acceptance.optical_acceptance import Measured
from recon.errors import InputError
from twin.experiments import filament_scans
from twin.ultrasound.transducer import Transducer

PLACES = (*((0.0, 5.0 * k) for k in range(1, 9)), (10.0, 20.0), (20.0, 20.0), (10.0, 35.0))
SCREEN = Screen(mm_per_px=(0.1, 0.08), dynamic_range_db=60.0)
PHANTOM = FilamentCertificate(places_mm=PLACES, expanded_mm=0.02, screen=SCREEN)
WIDTH = np.array([0.8, 0.4])  # mm at half of the amplitude
PER_SIGMA = 2 * np.sqrt(2 * np.log(2))


def drawn(rng, places=PLACES, speed_m_s=1540.0, top=200.0, count=4):
    """B-scans of Gaussian echoes in some noise, each shifted and turned."""
    images = []
    v, u = np.mgrid[:600, :360]
    grid = np.stack([0.1 * u, 0.08 * v], axis=-1)
    for _ in range(count):
        turn, shift = np.deg2rad(rng.uniform(-6, 6)), rng.uniform((6, -1), (9, 1))
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        centres = (np.array(places) @ rotation.T + shift) * [1, 1540 / speed_m_s]
        level = 60 + 4 * rng.standard_normal(u.shape)
        for centre in centres:
            fall = 10 * np.log10(np.e) * (((grid - centre) / (WIDTH / PER_SIGMA)) ** 2).sum(axis=-1)  # dB
            level = np.maximum(level, top - fall * 255 / 60)
        images.append(np.uint8(np.clip(np.rint(level), 0, 255)))
    return images


def test_places_and_widths_are_those_drawn(rng):
    """Distances to 0.05 mm, half a pixel; widths to 4 %, as profiles are straight from pixel to pixel."""
    seen = probe_filaments(drawn(rng), PHANTOM, "here")
    assert seen.numbers == tuple(range(len(PLACES)))
    distances = np.linalg.norm(seen.places[:, 1:] - seen.places[:, :1], axis=-1)
    assert distances == pytest.approx(np.tile(np.linalg.norm(np.subtract(PLACES[1:], PLACES[0]), axis=1), (4, 1)), abs=0.05)
    assert np.median(seen.widths, axis=(0, 1)) == pytest.approx(WIDTH, rel=0.04)


def test_depths_are_as_of_the_phantoms_speed_of_sound(rng):
    """In water; taken for a tissue-like phantom, depths alone would be 4 % too long."""
    images = drawn(rng, speed_m_s=1480.0)
    for speed, longer in ((1480.0, 0.0), (1540.0, 1540 / 1480 - 1)):
        phantom = PHANTOM.model_copy(update={"speed_m_s": speed})
        values = {
            one.place: one.budget.value_mm
            for one in judged(probe_filaments(images, phantom, "here"), phantom)
            if one.symbol == "UD"
        }
        assert values["filaments/00, 0-7"] == pytest.approx(35 * longer, abs=0.03)
        assert values["filaments/00, 8-9"] == pytest.approx(0, abs=0.05)


def judged(seen, phantom, draws=2000):
    measured = Measured({}, {}, {}, filaments={"filaments/00": seen})
    return optical_acceptance.judge(measured, Artefacts(filaments=phantom), Limits(), draws=draws).values


def test_intervals_hold_the_error_of_the_scanner(rng):
    """Of 150 phantoms drawn within their certificates, seen with 0.05 mm of noise by a scanner with 1 % too long a scale."""
    held, phantom = [], FilamentCertificate(places_mm=((0, 10), (0, 20), (15, 10)), expanded_mm=0.05, speed_limit_m_s=10.0)
    for _ in range(150):
        speed = 1540 + 10 * rng.uniform(-1, 1)
        places = np.array(phantom.places_mm) + 0.025 / np.sqrt(2) * rng.standard_normal((3, 2))
        shown = 1.01 * places * [1, 1540 / speed] + 0.05 / np.sqrt(2) * rng.standard_normal((5, 3, 2))
        for one in judged(Seen((0, 1, 2), shown, np.full((5, 3, 2), np.nan)), phantom, draws=500):
            first, second = (int(number) for number in one.place.split(", ")[1].split("-"))
            true = 0.01 * np.linalg.norm(np.subtract(phantom.places_mm[second], phantom.places_mm[first]))
            held.append(abs(one.budget.value_mm - true) <= one.budget.expanded_mm)
    assert len(held) == 450 and stats.binomtest(sum(held), len(held), 0.96).pvalue > 1e-3


def test_clipped_echoes_and_near_ones_have_no_width(rng):
    near = (*PLACES, (2.0, 40.0))
    phantom = PHANTOM.model_copy(update={"places_mm": near})
    widths = probe_filaments(drawn(rng, near), phantom, "here").widths
    assert np.isnan(widths[:, [7, -1]]).all() and np.isfinite(widths[:, :7]).all()
    assert np.isnan(probe_filaments(drawn(rng, top=300.0), PHANTOM, "here").widths).all()


@pytest.mark.parametrize(
    ("images", "said"),
    [
        (lambda rng: drawn(rng, count=2), "here: expected 3 B-scans or more, each with the probe placed again, found 2"),
        (lambda rng: [np.full((600, 360), 60, np.uint8)] * 3, "here: expected 3 filaments or more .* found 0"),
        (lambda rng: drawn(rng, rng.uniform((0, 5), (20, 40), (2, 2))), "another phantom, other mm_per_px"),
    ],
)
def test_what_shows_no_phantom_is_refused(images, said, rng):
    with pytest.raises(InputError, match=said):
        probe_filaments(images(rng), PHANTOM, "here")


def test_rendered_filaments_are_as_wide_as_the_pulse_and_narrowest_at_the_focus():
    """In depth a Gaussian pulse of the band there, to 10 %: a pixel is half as high. Distances are within their uncertainty."""
    scanner, speed = Transducer(), 1540e3 / 1e6  # mm/us
    screen = Screen(mm_per_px=scanner.scale_mm_per_px, dynamic_range_db=scanner.dynamic_range_db)
    phantom = FilamentCertificate(places_mm=tuple((0.0, 5.0 * k) for k in range(1, 10)), expanded_mm=0.02, screen=screen)
    seen = probe_filaments(filament_scans.render(phantom, scanner, 3), phantom, "here")
    depths = np.array(phantom.places_mm)[list(seen.numbers), 1]
    band = np.interp(depths, [0, 50], scanner.bandwidth) * scanner.frequency_mhz
    pulse = speed / 2 * PER_SIGMA**2 / (2 * np.pi * band)
    lateral, axial = np.median(seen.widths, axis=0).T
    assert axial == pytest.approx(pulse, rel=0.1)
    assert depths[lateral.argmin()] in {20, 25} and lateral[-1] > 1.2 * lateral.min()
    errors = [one.budget.value_mm / one.budget.expanded_mm for one in judged(seen, phantom) if one.symbol == "UD"]
    assert np.mean(np.abs(errors) < 1) > 0.9
