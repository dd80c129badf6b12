"""Numbers of a rig as identified anew, against those of the rig's file: which have changed beyond their standard deviations.

Most numbers are compared one by one, by their difference over the combined standard deviation. A device's optics are not: errors
of its focal lengths, centre and distortion go together, and so do those of its place. Each of the two is compared as a whole, by
the sum of both calibrations' covariances and that of usual drift: the squared length of the difference in standard deviations is
chi-square where nothing has changed. The scale of the board's print counts in both, though it is one error if the board is the
same.

Numbers that were not measured in both, or were taken over from the file, don't count. The limit is Bonferroni's, which holds
whatever correlations there are between numbers: of a rig that hasn't changed, any is flagged as seldom as any part of it is said
to have moved.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import stats

from recon.errors import InputError
from recon.geometry import camera_jacobian, rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.model.calibration import Calibration
from recon.model.part import NotNegative, Part, Positive
from recon.model.rig import DEVICES, Identified, Rig
from recon.rig_check import drift, fault_tests
from recon.rig_check.verdicts import PARTS, TITLES, described

Array = NDArray[np.float64]

OPTICS, PLACE = "optics", "place"
LEAST = 1e-10  # variance of a principal axis of the correlation from which on it counts: a rig's file has 12 digits
GRID = 9  # pixels along each side of an image at which optics are compared, for their effect in words
EXACT = 1e-9  # relative difference of numbers without a standard deviation, as of a hand-written file, that counts as one
UNITS = {"_mm_per_px": "mm/px", "_e_per_s": "e/s", "_mm": "mm", "_px": "px", "_um": "um", "_nm": "nm", "_dn": "DN", "_e": "e"}


class Number(Part):
    """A number of the rig, or the optics or the place of a device as a whole."""

    name: str  # by the rig's fields, such as cam1.lens.focus_mm, cam1.optics, cam2.place
    sigma: NotNegative  # of a normal number as unlikely as the difference, had nothing changed
    changed: bool
    change: str  # in words

    @property
    def device(self) -> str:
        """The device that it is of."""
        return self.name.partition(".")[0]

    @property
    def title(self) -> str:
        """What it is of its device, in words, such as `lens: focus`."""
        _, *parts, field = self.name.split(".")
        field = next((field.removesuffix(end) for end in UNITS if field.endswith(end)), field).replace("_", " ")
        return f"{' '.join(parts)}: {field}" if parts else field


class Version(Part):
    """A rig's file."""

    version: int
    identified: Identified | None = None

    @property
    def text(self) -> str:
        """In words."""
        source = "" if self.identified is None else f" ({self.identified.day}, {self.identified.capture})"
        return f"version {self.version}{source}"


class Comparison(Part):
    """A rig's file, and the same rig as identified anew."""

    before: Version
    today: Version
    limit_sigma: Positive  # beyond which a number has changed
    chance: Positive  # at most, of any being flagged of a rig that hasn't changed
    numbers: tuple[Number, ...] = Field(min_length=1)
    taken_over: int  # numbers that today's file has from the one before
    without_covariance: tuple[str, ...] = ()  # devices whose optics were measured in both, and can't be compared

    @property
    def changed(self) -> tuple[Number, ...]:
        """Those that have changed."""
        return tuple(one for one in self.numbers if one.changed)


def compare(before: Rig, today: Rig, drift_px: float, alarm_sigma: float) -> Comparison:
    """Compare what was measured in both.

    Parameters
    ----------
    drift_px : usual drift of principal points between both, as of `recon.rig_check.drift.usual_drift`
    alarm_sigma : standard deviations beyond which one of the rig's parts is said to have moved, in a check of all

    Raises
    ------
    InputError
        If the images' sizes differ, or nothing was measured in both.
    """
    for name in DEVICES:
        sizes = [getattr(one, name).optics.size for one in (before, today)]
        if sizes[0] != sizes[1]:
            expected, found = ("x".join(map(str, size)) for size in sizes)
            raise InputError(f"today: {name}.optics.size: expected {expected}, as of rig, found {found}: is it another rig?")
    own = [name for name in before.measured if name in today.measured and not _is_optics(name)]
    same = [name for name in own if _as_measured(before, name) == _as_measured(today, name)]
    found = [_one(before, today, name) for name in own if name not in same]
    found += _optics(before.calibration(), today.calibration(), drift_px)
    lacking = tuple(device for device in DEVICES if _measured_without_covariance(device, before, today))
    if not found:
        told = f"{len(same)} that are the same" if same else "none"
        raise InputError(f"today: expected numbers that were measured anew, as in rig, found {told}")
    found.sort(key=lambda one: (list(Rig.model_fields).index(one[0].partition(".")[0]), one[0]))
    chance = min(2 * len(PARTS) * float(stats.norm.sf(alarm_sigma)), 0.5)
    limit = float(stats.norm.isf(chance / (2 * len(found))))
    numbers = tuple(Number(name=name, sigma=sigma, changed=sigma > limit, change=change) for name, sigma, change in found)
    versions = [Version(version=one.version, identified=one.identified) for one in (before, today)]
    return Comparison(
        before=versions[0],
        today=versions[1],
        limit_sigma=limit,
        chance=chance,
        numbers=numbers,
        taken_over=len(same),
        without_covariance=lacking,
    )


def _is_optics(name: str) -> bool:
    return name.split(".")[:2] in [[device, "optics"] for device in DEVICES]


def _measured_without_covariance(device: str, *rigs: Rig) -> bool:
    """Whether optics of a device count as measured in all rigs, but not all know how their errors go together."""
    known = [() if one.optics_covariance is None else one.optics_covariance.names for one in rigs]
    covered = all(any(name.startswith(f"{device}.") for name in names) for names in known)
    return not covered and all(any(name.startswith(f"{device}.optics.") for name in one.measured) for one in rigs)


def _as_measured(rig: Rig, name: str) -> tuple[float, float, str]:
    return rig.number(name), rig.measured[name].sigma, rig.measured[name].source


def _one(before: Rig, today: Rig, name: str) -> tuple[str, float, str]:
    """A number that was measured by itself: its name, standard deviations, and the change in words."""
    values = [rig.number(name) for rig in (before, today)]
    difference, sigma = values[1] - values[0], float(np.hypot(*(rig.measured[name].sigma for rig in (before, today))))
    unit = next((f" {unit}" for end, unit in UNITS.items() if name.endswith(end)), "")
    deviations = abs(difference) / max(sigma, EXACT * max(1.0, *map(abs, values)))
    return name, deviations, f"{difference:+.3g} ± {sigma:.2g}{unit}, from {values[0]:.4g}{unit}"


def _optics(before: Calibration, today: Calibration, drift_px: float) -> Iterator[tuple[str, float, str]]:
    """Each device's optics and place, as of `_one`; none of a device whose calibration is the same, or has no covariance."""
    if before.uncertainty is None or today.uncertainty is None:
        return
    known = [before.uncertainty, today.uncertainty]
    parts = [*known, *([drift.usual_drift(before.cameras, drift_px)] if drift_px else [])]
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    covariance = np.sum([part.ordered(names) for part in parts], axis=0)
    for device, old in before.cameras.items():
        new = today.cameras[device]
        difference = _difference(old, new)
        if not difference or not all(any(name.startswith(f"{device}.") for name in each.names) for each in known):
            continue
        for kind, parameters in ((OPTICS, (*MATRIX, *DISTORTION)), (PLACE, MOTION)):
            places = [k for k, name in enumerate(names) if name in {f"{device}.{one}" for one in parameters}]
            if not places:
                continue  # the world's device has no place
            own = tuple(names[k].partition(".")[2] for k in places)
            moved, within = np.array([difference.get(one, 0.0) for one in own]), covariance[np.ix_(places, places)]
            words = _bent(old, new, own, within) if kind == OPTICS else _shifted(device, moved, within)
            yield f"{device}.{kind}", _deviation(moved, within), words


def _difference(old: Camera, new: Camera) -> dict[str, float]:
    """Parameters of a device by which two calibrations differ."""
    ends = [np.zeros(len(DISTORTION)) for _ in range(2)]
    for end, camera in zip(ends, (old, new), strict=True):
        end[: camera.distortion.size] = camera.distortion
    matrices = [camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in (old, new)]
    motion = rigid.difference(old.camera_from_world, new.camera_from_world)
    changes = np.concatenate([matrices[1] - matrices[0], ends[1] - ends[0], motion])
    return {name: float(one) for name, one in zip(camera_jacobian.PARAMETERS, changes, strict=True) if one != 0}


def _deviation(difference: Array, covariance: Array) -> float:
    """Standard deviations of a normal number as unlikely as a difference : (k,) of a covariance : (k, k)."""
    sigma = np.sqrt(np.diag(covariance))
    known = sigma > 0
    variances, axes = np.linalg.eigh((covariance[known] / sigma[known][:, None])[:, known] / sigma[known])
    shown = variances > LEAST
    statistic = float(np.sum((axes.T @ (difference[known] / sigma[known]))[shown] ** 2 / variances[shown]))
    return fault_tests.as_sigma(statistic, int(shown.sum()))


def _bent(old: Camera, new: Camera, names: tuple[str, ...], covariance: Array) -> str:
    """The effect of changed optics in words: root mean square over the image, and as it is usual."""
    here = [Camera(one.size, one.matrix, one.distortion, np.eye(4)) for one in (old, new)]
    spans = (np.linspace(0, length - 1, GRID) for length in old.size)
    pixels = np.stack(np.meshgrid(*spans), axis=-1).reshape(-1, 2)
    rays = here[0].rays(pixels)
    moved = np.linalg.norm(here[1].project(rays) - pixels, axis=1)
    slopes = camera_jacobian.linearise(here[0], rays, names).by_parameter
    usual = np.einsum("nai,ij,naj->n", slopes, covariance, slopes)
    longer = [f"{one:+.2f}" for one in np.diag(new.matrix - old.matrix)[:2]]
    size, least = (float(np.sqrt(np.nanmean(each))) for each in (moved**2, usual))
    return f"pixels moved by {size:.2f} px, {least:.2f} by chance; focal lengths by {' and '.join(longer)} px"


def _shifted(device: str, motion: Array, covariance: Array) -> str:
    """A changed place in words."""
    turn, shift = (float(np.sqrt(np.trace(covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
    return f"{described(device, motion)}; {np.degrees(turn):.3f} deg and {shift:.2f} mm by chance"


def told(numbers: tuple[Number, ...]) -> str:
    """Numbers in words, by device."""
    devices = dict.fromkeys(one.device for one in numbers)
    groups = {device: ", ".join(one.title for one in numbers if one.device == device) for device in devices}
    return "; ".join(f"{TITLES.get(device, device)}'s {titles}" for device, titles in groups.items())
