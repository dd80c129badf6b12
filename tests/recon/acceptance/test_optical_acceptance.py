"""Test values against errors that were put in, and the certificate that says them."""

import numpy as np
import pytest
from scipy import stats

from recon.acceptance import certificate_page, certificate_sheet, gum_budget, optical_acceptance, prescribed_places
from recon.acceptance.certificate_page import Subject
from recon.acceptance.certificates import Artefacts, BallCertificate, BarCertificate, Certified, PlateCertificate
from recon.acceptance.conformity import Limits
from recon.acceptance.gum_budget import Input
from recon.acceptance.optical_acceptance import Measured
from tests.recon.acceptance import drawn_surfaces

DIAMETER, LENGTH, BALL, SIGMA = 39.6, 150.0, 38.1, 0.01
EXACT = {"expansion_per_k": 11.5e-6, "expansion_limit_per_k": 0.0}
ARTEFACTS = Artefacts(
    temperature_c=24.0,
    temperature_limit_c=0.5,
    sphere=BallCertificate(diameter=Certified(mm=DIAMETER, expanded_mm=0.002), form_mm=0.002, coat_mm=0.01, **EXACT),
    bar=BarCertificate(
        length=Certified(mm=LENGTH, expanded_mm=0.004),
        diameters=(Certified(mm=BALL, expanded_mm=0.002), Certified(mm=BALL, expanded_mm=0.002)),
        rod_mm=8.0,
        **EXACT,
    ),
    plane=PlateCertificate(size_mm=(220.0, 170.0), form_mm=0.002),
)
WARM = 1 + 4 * 11.5e-6  # of lengths at 24 deg C
LIMITS = Limits()


def measured(rng, size=0.0, spacing=0.0, sag=0.0, places=None):
    """All artefacts in their places, warm and painted, by a rig with errors in mm."""
    volume, radius = ARTEFACTS.volume, DIAMETER * WARM / 2 + 0.01 + size / 2
    spheres = prescribed_places.spheres(volume, DIAMETER)[:places]
    bars = zip(*(part[:places] for part in prescribed_places.bars(volume, LENGTH, BALL)), strict=True)
    half, ball = (LENGTH * WARM + spacing) / 2, BALL * WARM / 2 + size / 2

    def two(middle, along):
        ends = (middle - half * along, middle + half * along)
        return tuple(drawn_surfaces.ball(end, ball, rng, SIGMA) for end in ends)

    return Measured(
        {f"sphere/{k:02d}": drawn_surfaces.ball(centre, radius, rng, SIGMA) for k, centre in enumerate(spheres)},
        {f"bar/{k:02d}": two(middle, along) for k, (middle, along) in enumerate(bars)},
        {
            f"plane/{k:02d}": drawn_surfaces.plate(centre, (220, 170), rng, SIGMA, sag=sag)
            for k, centre in enumerate(prescribed_places.planes(volume)[0][:places])
        },
    )


def judged(points, seed=0):
    return optical_acceptance.judge(points, ARTEFACTS, LIMITS, seed, draws=4000, repeats=40)


def mean(found, symbol):
    return np.mean([one.budget.value_mm for one in found.values if one.symbol == symbol])


def test_a_perfect_rig_has_no_errors_beside_its_noise(rng):
    """Warmth and paint are corrected: without, sizes would be 0.02 mm off, and lengths 0.007. All demands are met."""
    found = judged(measured(rng))
    assert found.decision == "accepted" and found.complete and len(found.values) == 3 * 10 + 2 * 7 + 2 * 6
    for symbol in ("PS", "SD", "E"):
        own = [one.budget for one in found.values if one.symbol == symbol]
        assert abs(mean(found, symbol)) < 0.004
        assert all(abs(one.value_mm) < 2 * one.expanded_mm for one in own)
    sigmas = {"PF95": 3.92, "F95": 3.92}
    assert {symbol: mean(found, symbol) / SIGMA for symbol in sigmas} == pytest.approx(sigmas, abs=0.2)


def test_errors_that_were_put_in_are_found(rng):
    """A diameter 0.05 mm too large, a spacing 0.08 mm too long, and a sag of 0.6 mm; E has both."""
    found = judged(measured(rng, size=0.05, spacing=0.08, sag=0.6, places=3))
    assert mean(found, "PS") == pytest.approx(0.05, abs=0.006)
    assert mean(found, "SD") == pytest.approx(0.08, abs=0.006) and mean(found, "E") == pytest.approx(0.13, abs=0.01)
    assert mean(found, "F") == pytest.approx(0.6, abs=0.08)
    assert found.decision_of("F") == "rejected" and found.decision_of("SD") == "accepted" and found.decision == "rejected"


def test_budgets_name_their_causes(rng):
    """Of a spacing error: noise, certificate, temperature; expansion is exact, and a certificate's U counts by its k."""
    budget = judged(measured(rng, places=1)).worst_values["SD"].budget
    parts = {row.input.name: row for row in budget.rows}
    assert parts["certified length"].contribution_mm == pytest.approx(0.002, rel=1e-3)
    assert parts["temperature"].contribution_mm == pytest.approx(LENGTH * 11.5e-6 * 0.5 / np.sqrt(3), rel=1e-3)
    assert parts["expansion"].contribution_mm == 0 and parts["mounting"].contribution_mm == 0
    noise = [row.input.standard for name, row in parts.items() if name.startswith("centre")]
    assert len(noise) == 2 and all(0.5 * SIGMA / 20 < sigma < 4 * SIGMA / 20 for sigma in noise)  # 400 patches, a cap of 60 deg


def test_the_same_seed_gives_the_same_certificate(rng):
    points = measured(rng, places=1)
    first, again, other = judged(points), judged(points), judged(points, seed=1)
    assert first.values == again.values and first.values != other.values


def test_an_arrangement_that_lacks_places_is_told(rng):
    """The values are judged all the same, and the verdict says that the test isn't whole."""
    found = judged(measured(rng, places=3))
    lacking = {one.words for one in found.demands if not one.met}
    assert {"sphere: 10 places", "bar: 7 places", "plane: 6 places", "sphere: in all eight octants"} <= lacking
    assert "Not a whole test by VDI/VDE 2634: " in certificate_page.verdict(found)


def test_prescribed_places_meet_all_demands():
    """Balls stay in the volume, bars point all ways."""
    volume = ARTEFACTS.volume
    low = np.array(volume.centre_mm) - np.array(volume.size_mm) / 2
    middles, along = prescribed_places.bars(volume, LENGTH, BALL)
    ends = np.concatenate([middles + side * along * LENGTH / 2 for side in (-1, 1)])
    for places, radius in ((prescribed_places.spheres(volume, DIAMETER), DIAMETER / 2), (ends, BALL / 2)):
        assert (places - radius >= low - 1e-9).all() and (places + radius <= low + volume.size_mm + 1e-9).all()
    assert np.linalg.matrix_rank(along) == 3 and len(np.unique(np.round(np.abs(along @ along.T) - np.eye(7), 6) == 1)) == 1
    spheres = prescribed_places.spheres(volume, DIAMETER)
    found = {"sphere": spheres, "bar": middles, "plane": prescribed_places.planes(volume)[0]}
    assert all(one.met for one in prescribed_places.demands(ARTEFACTS, found))


def test_the_page_and_the_sheet_say_the_same(rng, tmp_path):
    """The verdict, each quantity with its U, budgets; and lines to sign. Markup in a name is text."""
    pdfium = pytest.importorskip("pypdfium2")
    found, subject = judged(measured(rng, places=1)), Subject("Rig <3> & co", "", "2026-12-01", ARTEFACTS)
    html = certificate_page.write_text(found, subject)
    assert "Rig &lt;3&gt; &amp; co" in html and certificate_page.verdict(found) in html
    pages = certificate_sheet.write(tmp_path / "one.pdf", found, subject)
    certificate_sheet.write(tmp_path / "two.pdf", found, subject)
    assert (tmp_path / "one.pdf").read_bytes() == (tmp_path / "two.pdf").read_bytes()
    document = pdfium.PdfDocument(tmp_path / "one.pdf")
    text = " ".join(" ".join(page.get_textpage().get_text_range() for page in document).split())
    assert len(document) == pages <= 5 and "Rig <3> & co" in text and "Accepted: all 7 test values" in text
    for symbol, one in found.worst_values.items():
        words = certificate_page.in_words(one.budget)
        assert words.replace(" mm", "") in html.replace("\u00a0", " ") and words.replace("−", "-") in text
        assert f"{symbol} at {one.place}" in text and "share of variance" in text
    assert "signature" in text and "2026-12-01" in text


def test_repeats_tell_what_a_sequence_shifts_alike(rng):
    """Sizes with shifts of 0.02 mm a sequence, noise of 0.01 mm: 95 % of the intervals hold the mean, 62 % without repeats.

    1200 tests of three recordings in each of four places; of such shares 0.6 % is a standard deviation, if all were independent.
    """
    held = {True: [], False: []}
    for _ in range(100):
        errors = np.hypot(0.02, 0.01) * rng.standard_normal((4, 3))
        tests = [
            optical_acceptance.Test("PS", f"sphere/0{place}{'-again' * again}", 100, lambda x: x["size"],
                                    [Input("size", error, 0.01, "A")])
            for place, own in enumerate(errors) for again, error in enumerate(own)
        ]  # fmt: skip
        for repeats, own in ((True, optical_acceptance.with_repeats(tests)), (False, tests)):
            budgets = [gum_budget.evaluate(test.model, test.inputs, rng, draws=2000) for test in own]
            held[repeats] += [abs(one.value_mm) <= one.expanded_mm for one in budgets]
    assert np.mean(held[True]) == pytest.approx(0.95, abs=0.025)
    assert np.mean(held[False]) == pytest.approx(2 * stats.norm.cdf(1.96 * 0.01 / np.hypot(0.02, 0.01)) - 1, abs=0.05)


def test_a_repeat_is_no_place(rng):
    """It counts for the scatter, in all values of its quantity, and for no demand on the arrangement."""
    points = measured(rng, places=3)
    again = drawn_surfaces.ball(prescribed_places.spheres(ARTEFACTS.volume, DIAMETER)[0], DIAMETER * WARM / 2 + 0.05, rng, SIGMA)
    found = judged(points._replace(spheres={**points.spheres, "sphere/00-again": again}))
    assert len(found.middles["sphere"]) == 3
    inputs = {one.symbol: [row.input.name for row in one.budget.rows] for one in found.values}
    assert optical_acceptance.SEQUENCE in inputs["PS"] and optical_acceptance.SEQUENCE not in inputs["SD"]
    own = [one.budget.rows[-1].input for one in found.values if one.symbol == "PS"]
    assert len(set(own)) == 1 and own[0].freedom == 1
    assert own[0].standard == pytest.approx(0.08 / np.sqrt(2), rel=0.1)
