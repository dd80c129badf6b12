"""Acceptance tests of drawn rigs, whose errors are known: coverage of uncertainties, and decisions on good and bad rigs.

A rig is drawn from a calibration and its covariance; artefacts are drawn within their certificates; what camera 1 and the fringes
see of them is drawn with noise that neighbours share; the software has the calibration, the certificates and the points alone. A
bad rig has one fault, twice the limit in size: noise, a scale, or a bend. `sonotwin study name=acceptance` has a thousand tests.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.acceptance import gum_budget, optical_acceptance, prescribed_places
from recon.acceptance.certificates import Artefacts, BallCertificate, BarCertificate, Certified, PlateCertificate
from recon.acceptance.conformity import Limits
from recon.acceptance.form_probing import ALL, MOST, shell_width
from recon.acceptance.optical_acceptance import Acceptance, Measured
from recon.files.metrics import Metrics
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import slopes_at
from recon.geometry.primitives import Plane, Sphere, fit_plane, fit_sphere
from recon.model.calibration import Calibration
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, points_by_light
from scenes.board_poses import Config as Poses
from twin.conditions import IDEAL
from twin.experiments import drawn_artefacts, drawn_check, drawn_session
from twin.experiments.drawn_session import Noise
from twin.experiments.experiment_runs import Experiment, Fault, Settings

Array = NDArray[np.float64]
Devices = Mapping[str, Camera]

FAULTS: tuple[Fault, ...] = get_args(Fault)
SIGMA_PX = 0.02  # of the projector's column that a pixel sees
NOISY = 5.0
TWICE = 2.0  # limits, of a bad rig's error
PATCHES, SHARED = 500, 4  # of an artefact, and points of each, which share their noise
REDRAWN = 50  # times that a shell's mean width is drawn
MIRRORED = 4  # times that noise of a ball is drawn, and turned over, for its mean fit
CAP = 0.6  # cosine to the line of sight, up to which a ball is seen
ARTEFACTS = Artefacts(
    sphere=BallCertificate(diameter=Certified(mm=39.6, expanded_mm=0.002), form_mm=0.001),
    bar=BarCertificate(
        length=Certified(mm=150.0, expanded_mm=0.003),
        diameters=(Certified(mm=38.1, expanded_mm=0.002), Certified(mm=38.1, expanded_mm=0.002)),
        rod_mm=8.0,
    ),
    plane=PlateCertificate(size_mm=(220.0, 170.0), form_mm=0.002),
)


@dataclass(frozen=True)
class Seen:
    """An artefact as a true rig shows it, measured by the calibration that is in use."""

    points: Array  # (n, 3) mm, without noise
    slopes: Array  # (n, 3) mm for one px of the projector's column


class Rigs(NamedTuple):
    """A rig as it is, and as its calibration has it."""

    true: Devices
    known: Devices


class Audited(NamedTuple):
    """A drawn test."""

    acceptance: Acceptance
    truth_mm: tuple[float, ...]  # of each of its values

    @property
    def covered(self) -> list[tuple[str, bool]]:
        """Of each value whether its interval holds the truth."""
        return [
            (one.symbol, abs(one.budget.value_mm - truth) <= one.budget.expanded_mm)
            for one, truth in zip(self.acceptance.values, self.truth_mm, strict=True)
        ]


def audit(known: Calibration, limits: Limits, fault: Fault, seed: int, draws: int = 10_000, repeats: int = 100) -> Audited:
    """One acceptance test of a drawn rig.

    Parameters
    ----------
    known : the calibration that the software has, with its covariance
    """
    assert known.uncertainty is not None and ARTEFACTS.sphere is not None and ARTEFACTS.plane is not None
    rng = np.random.default_rng([seed, FAULTS.index(fault)])
    rig = Rigs(drawn_check.drawn_rig(known.cameras, known.uncertainty, rng), known.cameras)
    actual = drawn_artefacts.draw(ARTEFACTS, rng)
    bent = partial(_bent, fault=fault, limits=limits)
    noise_px = SIGMA_PX * (NOISY if fault == "noise" else 1.0)

    def measure(seen: Seen) -> Array:
        exact, further = bent(seen.points), bent(seen.points + SIGMA_PX * seen.slopes)
        return exact + noise_px / SIGMA_PX * _shared(len(exact), rng)[:, None] * (further - exact)

    def mean_widths(seen: Seen, shape: Sphere | Plane, own: Array) -> Array:
        """Mean widths of the shells over much noise, by least squares that are linear about the exact shape."""
        exact = bent(seen.points)
        errors = shape.distance(bent(seen.points + SIGMA_PX * seen.slopes)) - shape.distance(exact)
        noise = noise_px / SIGMA_PX * np.stack([_shared(len(exact), rng) for _ in range(REDRAWN)])
        residuals = shape.distance(exact) + noise * errors
        basis = np.linalg.qr(own)[0]
        residuals -= residuals @ basis @ basis.T
        return np.array([shell_width(residuals, share).mean() for share in (ALL, MOST)])

    def mean_sphere(seen: Seen) -> Sphere:
        """Mean of the spheres fitted to a ball over much noise.

        It isn't the exact points' fit: least squares of distances from a sphere that is seen in a cap, with noise along the line
        of sight, shrink the radius by some 14 sigma^2 / radius. Noise and its negative leave of the scatter even orders alone.
        """
        exact = bent(seen.points[::SHARED])
        step = noise_px / SIGMA_PX * (bent(seen.points[::SHARED] + SIGMA_PX * seen.slopes[::SHARED]) - exact)
        noise = rng.standard_normal((MIRRORED, len(exact), 1)) * step
        fits = [fit_sphere(exact + one).shape for half in noise for one in (half, -half)]
        return Sphere("", np.mean([one.centre for one in fits], axis=0), float(np.mean([one.radius for one in fits])))

    truths = dict[tuple[str, str], float]()
    spheres, bars, planes = dict[str, Array](), dict[str, tuple[Array, Array]](), dict[str, Array]()
    for k, centre in enumerate(prescribed_places.spheres(ARTEFACTS.volume, 2 * actual.radius_mm)):
        name, perfect = f"sphere/{k:02d}", _ball(rig, centre, actual.radius_mm, [seed, k])
        spheres[name] = measure(_ball(rig, centre, actual.radius_mm, [seed, k], ARTEFACTS.sphere.form_mm))
        exact = fit_sphere(bent(perfect.points)).shape
        truths[name, "PS"] = 2 * (mean_sphere(perfect).radius - actual.radius_mm)
        outwards = (bent(perfect.points) - exact.centre) / exact.radius
        widths = mean_widths(perfect, exact, np.column_stack([outwards, np.ones(len(outwards))]))
        truths |= {(name, symbol): float(width) for symbol, width in zip(("PF", "PF95"), widths, strict=True)}
    middles, directions = prescribed_places.bars(ARTEFACTS.volume, actual.length_mm, 38.1)
    for k, (middle, along) in enumerate(zip(middles, directions, strict=True)):
        name, ends = f"bar/{k:02d}", (middle - along * actual.length_mm / 2, middle + along * actual.length_mm / 2)
        balls = [_ball(rig, end, actual.ball_radius_mm, [seed, k]) for end in ends]
        bars[name] = (measure(balls[0]), measure(balls[1]))
        first, second = (mean_sphere(one) for one in balls)
        truths[name, "SD"] = float(np.linalg.norm(second.centre - first.centre)) - actual.length_mm
        truths[name, "E"] = truths[name, "SD"] + first.radius + second.radius - 2 * actual.ball_radius_mm
    for k, (middle, tilt) in enumerate(zip(*prescribed_places.planes(ARTEFACTS.volume), strict=True)):
        name, perfect = f"plane/{k:02d}", _plate(rig, middle, tilt, [seed, k])
        planes[name] = measure(_plate(rig, middle, tilt, [seed, k], ARTEFACTS.plane.form_mm))
        exact = fit_plane(bent(perfect.points)).shape
        widths = mean_widths(perfect, exact, np.column_stack([bent(perfect.points)[:, :2], np.ones(len(perfect.points))]))
        truths |= {(name, symbol): float(width) for symbol, width in zip(("F", "F95"), widths, strict=True)}
    found = optical_acceptance.judge(Measured(spheres, bars, planes), ARTEFACTS, limits, seed, draws, repeats)
    return Audited(found, tuple(truths[one.place, one.symbol] for one in found.values))


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one test: values, those whose intervals hold the truth, all and by quantity, and the decision."""
    known = drawn_session.calibrated_optics(settings.rig, IDEAL, Noise(), Poses(), 0)
    audited = audit(known, Limits(), settings.acceptance.fault, seed)
    covered = audited.covered
    by = {f"covered_{symbol}": sum(held for one, held in covered if one == symbol) for symbol in dict(covered)}
    decisions = {word: int(audited.acceptance.decision == word) for word in ("accepted", "rejected", "neither")}
    expected = gum_budget.COVERAGE * len(covered)
    return {"values": len(covered), "covered": sum(held for _, held in covered), "expected": expected, **by, **decisions}


def _seen(rig: Rigs, points: Array) -> Seen:
    """Patches at points : (p, 3) mm."""
    pixels, columns = rig.true[CAMERAS[0]].project(points), rig.true[PROJECTOR].project(points)[:, :1]
    exact, rays = points_by_light(pixels, columns, (0,), rig.known), rig.known[CAMERAS[0]].rays(pixels)
    per_mm = np.einsum("mi,mi->m", slopes_at(rig.known[PROJECTOR], exact)[:, 0], rays)
    return Seen(np.repeat(exact, SHARED, axis=0), np.repeat(rays / per_mm[:, None], SHARED, axis=0))


def _ball(rig: Rigs, centre: Array, radius: float, seed: list[int], form_mm: float = 0.0) -> Seen:
    """A ball as far as it faces camera 1: patches, the same for a seed; with a deviation from its form, peak to valley."""
    rng, sight = np.random.default_rng(seed), rig.true[CAMERAS[0]].centre - centre
    directions = rng.standard_normal((20 * PATCHES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    facing = directions @ sight / np.linalg.norm(sight) > CAP
    directions = directions[facing][:PATCHES]
    wave = rng.standard_normal(3)
    uneven = form_mm / 2 * np.sin(3 * directions @ wave + rng.uniform(0, 2 * np.pi))
    return _seen(rig, centre + directions * (radius + uneven[:, None]))


def _plate(rig: Rigs, middle: Array, tilt_deg: Array, seed: list[int], form_mm: float = 0.0) -> Seen:
    """A plate tilted about x, then y, likewise; with a deviation from its form, peak to valley."""
    assert ARTEFACTS.plane is not None
    rng = np.random.default_rng(seed)
    aside = rng.uniform(-0.5, 0.5, (PATCHES, 2))
    uneven = form_mm / 2 * np.sin(3 * aside @ rng.standard_normal(2) + rng.uniform(0, 2 * np.pi))
    places = np.column_stack([aside * ARTEFACTS.plane.size_mm, uneven])
    return _seen(rig, Rotation.from_euler("xy", tilt_deg, degrees=True).apply(places) + middle)


def _shared(count: int, rng: np.random.Generator) -> Array:
    """Standard normal numbers : (n,) that neighbours share."""
    return np.repeat(rng.standard_normal(-(-count // SHARED)), SHARED)[:count]


def _bent(points: Array, fault: Fault, limits: Limits) -> Array:
    """Points as a rig with a fault measures them."""
    assert ARTEFACTS.bar is not None and ARTEFACTS.plane is not None and limits.sd_mm is not None and limits.f_mm is not None
    if fault == "scale":
        return points * (1 + TWICE * limits.sd_mm / ARTEFACTS.bar.length.mm)
    if fault == "bend":
        aside = points[:, :2] - ARTEFACTS.volume.centre_mm[:2]
        corner = np.sum((np.array(ARTEFACTS.plane.size_mm) / 2) ** 2)
        return points + np.outer(TWICE * limits.f_mm * np.sum(aside**2, axis=1) / corner, [0.0, 0.0, 1.0])
    return points


EXPERIMENT = Experiment(
    ("rig", "acceptance"),
    measure,
    {"covered": "expected"},
    "95 % of the values",
    counts=("values", "covered", "accepted", "rejected", "neither"),
)
