"""Masses of a breast that is swept once and taken in several ways: their features, and whether each was found whole and measured.

A mass taken one way is a pair, from which the coefficients of `recon.segmentation.detectability` are fitted. Poses have the noise
of `PoseNoise` and its covariance; probe, lag and the mean speed of sound are known, and so is the skin.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans
from recon.freehand.volume_compounding import Clip
from recon.geometry import rigid
from recon.geometry.surface_tree import signed_distances
from recon.segmentation import detectability, echo_power, insonation, masses
from recon.segmentation.detectability import Calibration, Features
from recon.segmentation.mass_network import Looks
from recon.segmentation.mass_surface import Mass
from recon.segmentation.refraction import Sound
from recon.session import masses_step
from scenes.acoustics import TISSUES
from scenes.kinds import breast
from scenes.kinds.breast import Tumour
from scenes.mass_forms import MassForm
from scenes.scene_types import Thing
from twin.evaluation import sweep_errors
from twin.experiments import mass_trial, patient_trial
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.mass_conditions import EDGE_MM, GIVES_MM, LEAST_MM
from twin.filmed_sweep import SweepSettings
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Levels = Callable[[Sequence[Thing], Scans], Array]

SEED = 900  # of the first breast
WAYS = ("all", "every", "gap", "first")  # in which a sweep is taken
METHOD = masses_step.Method(overlays=0)
LOOKS = Looks(METHOD.looks)
STEP_MM, SHELL_MM = 0.5, 3.0  # of the grid on which echoes are averaged, and around a mass, with which its own are compared
LEAST_POWER = 1e-3  # of the tissue's: cysts have none
DRAWN = {"any_words": True, "count": (2, 5), "size_mm": (6.0, 22.0), "apart_mm": 1.0}  # masses of patients


@dataclass(frozen=True)
class SiliconeMasses:
    """How masses of silicone breasts are drawn."""

    count: tuple[int, int] = (5, 7)
    size_mm: tuple[float, float] = (3.0, 25.0)  # diameters of balls of the same volume, evenly by ratio
    contrast_db: tuple[float, float] = (1.0, 20.0)
    bright: float = 0.2  # share that is brighter than the silicone
    forms: tuple[MassForm, ...] = ("round", "oval", "lobulated")
    apart_mm: float = 3.0  # at least, between spheres of their greatest extents
    low_mm: tuple[float, float, float] = (-40.0, -32.0, 8.0)  # of middles in the phantom's frame: under the raster, so that
    high_mm: tuple[float, float, float] = (32.0, 23.0, 46.0)  # some masses are cut at its sides
    tries: int = 2000  # of a place


@dataclass(frozen=True)
class Whole:
    """When a mass counts as found whole and measured."""

    centre: float = 0.5  # most error, of the radius of a ball of its volume
    volume: float = 0.3  # of its own


SILICONE, WHOLE = SiliconeMasses(), Whole()


class Pair(NamedTuple):
    """A mass taken one way; a study has columns `pair00_way` and so on."""

    way: float  # number in WAYS
    size_mm: float  # diameter of a ball of its volume
    contrast_db: float  # from the tissue
    uneven_db: float  # of the tissue, as measured
    detectability: float
    resolved: float
    unseen: float
    bright: float
    centre_error_mm: float  # NaN where none was found
    volume_error_percent: float
    found: float  # 1 of one found whole and measured, else 0

    @property
    def features(self) -> Features:
        """Features of the mass."""
        return Features(*(np.array(getattr(self, name)) for name in Features._fields))

    @property
    def calibration(self) -> Calibration:
        """Coefficients for its tissue."""
        return detectability.calibration_for(self.uneven_db, LOOKS)


@dataclass(frozen=True)
class Kind:
    """A kind of breasts, and how they are swept."""

    scene: Callable[[int], dict[str, Any]]  # of a seed
    path: SurfacePath
    clocks: Clocks
    speed_m_s: float
    levels: Levels  # of n masses over the tissue, (n,) dB; NaN of one that no B-scan shows


def measure(settings: Settings, seed: int) -> Metrics:
    """All pairs of one breast, their number, the number found and the number expected by the coefficients in use."""
    kind = KINDS[settings.seen.tissue]
    chosen = SweepSettings(
        rig=settings.rig,
        scene=kind.scene(seed),
        ultrasound=settings.ultrasound,
        path=kind.path,
        clocks=kind.clocks,
        seed=seed,
    )
    planned = mass_trial.tracked(chosen)
    things = planned.scene.things
    skin = sweep_errors.facing(next(thing.mesh for thing in things if thing.name == "breast"))
    hidden = [thing for thing in things if thing.name.startswith(("tumour", "mass"))]  # not a cyst's solid part
    with TemporaryDirectory() as folder:
        scans = freehand_scans.in_memory(mass_trial.recorded(planned, Path(folder), kind.speed_m_s))
    levels = kind.levels(hidden, scans)
    shown = np.isfinite(levels)
    hidden, levels = [thing for thing, there in zip(hidden, shown, strict=True) if there], levels[shown]
    pairs = list[Pair]()
    for way, kept in enumerate(kept_scans(planned.plan.truth.times * 1e-9, np.random.default_rng([seed, 52]))):
        taken = replace(scans, world_from_pixel=np.where(kept[:, None, None], scans.world_from_pixel, np.nan))
        pairs += pairs_of(way, hidden, levels, taken, skin)
    return figures(pairs)


def silicone(seed: int) -> dict[str, Any]:
    """A silicone breast with drawn masses.

    Raises
    ------
    InputError
        If one finds no place.
    """
    rng, drawn = np.random.default_rng([seed, 51]), SILICONE
    fields: dict[str, Any] = {"seed": SEED + seed, "edge_mm": EDGE_MM, "tissue_mm": LEAST_MM}
    fields |= {"apart_mm": drawn.apart_mm - GIVES_MM}
    count = int(rng.integers(*drawn.count, endpoint=True))
    sizes = np.sort(np.exp(rng.uniform(*np.log(drawn.size_mm), count)))[::-1]  # large ones first, while there is room
    signs = np.where(rng.random(count) < drawn.bright, 1, -1)
    echoes = (TISSUES["silicone"].echogenicity or 0.0) + signs * rng.uniform(*drawn.contrast_db, count)
    forms = [drawn.forms[k] for k in rng.integers(len(drawn.forms), size=count)]
    looks = [Tumour(size_mm=10, centre_mm=(0, 0, 0), form=one, echo_db=echo) for one, echo in zip(forms, echoes, strict=True)]
    config = breast.Config(tumours=tuple(looks), **fields)
    under = breast.depth_in(breast.open_mesh(breast.skin_of(config)))
    placed = list[Tumour]()
    for look, body, size in zip(looks, breast.bodies_of(config), sizes, strict=True):
        larger = size / ball_mm(body)
        extent = look.size_mm * larger
        for centre in rng.uniform(drawn.low_mm, drawn.high_mm, (drawn.tries, 3)):
            if any(np.linalg.norm(centre - one.centre_mm) < (extent + one.size_mm) / 2 + drawn.apart_mm for one in placed):
                continue
            moved = trimesh.Trimesh(larger * body.vertices + centre, body.faces, process=False)
            if breast.least_tissue(moved, under) >= LEAST_MM:
                placed.append(look.model_copy(update={"size_mm": extent, "centre_mm": tuple(centre.tolist())}))
                break
        else:
            raise InputError(f"masses: expected room for {count}, found none for one of {size:.1f} mm; take another seed")
    return {"kind": "breast", **fields, "tumours": [one.model_dump(mode="json") for one in placed]}


def patient(seed: int) -> dict[str, Any]:
    """A patient with drawn masses of any words."""
    anatomy = {"density": patient_trial.DENSITIES[seed % len(patient_trial.DENSITIES)]}
    return {"kind": "patient", "seed": SEED + seed, "edge_mm": EDGE_MM, "anatomy": anatomy, "masses": "drawn", "drawn": DRAWN}


def kept_scans(times_s: Array, rng: np.random.Generator) -> list[Mask]:
    """B-scans : (n,) that keep their poses in each of the WAYS: all, every 2nd to 5th, all but 0.3 to 1 s, a first part."""
    number, every, part = np.arange(len(times_s)), rng.integers(2, 5, endpoint=True), rng.choice([1 / 2, 2 / 3])
    middle_s, lost_s = rng.uniform(times_s[0], times_s[-1]), rng.uniform(0.3, 1.0)
    return [number >= 0, number % every == 0, np.abs(times_s - middle_s) > lost_s / 2, number < part * len(times_s)]


def set_levels(hidden: Sequence[Thing], scans: Scans) -> Array:
    """Levels : (n,) dB of masses over silicone, as their echoes are set."""
    silicone = TISSUES["silicone"]
    tissues = [thing.tissue or TISSUES["tumour"] for thing in hidden]
    return np.array([(one.echogenicity or 0.0) - (silicone.echogenicity or 0.0) for one in tissues])


def shown_levels(hidden: Sequence[Thing], scans: Scans) -> Array:
    """Levels : (n,) dB of masses over what is around them, as B-scans show them: NaN of one that none shows.

    The mean echo power inside the true surface, over that of a shell of SHELL_MM outside, without other masses there; on the
    grey scale that the software assumes, in which the tissue's unevenness is told, too.
    """
    placed, (height, width) = scans.world_from_pixel, scans.shape
    clip = Clip(0, int(np.ceil(insonation.LIMITS.ringing_mm / echo_power.pixel_mm(placed)[1])), width, height)
    grid = echo_power.beam_grid(placed, scans.shape, (STEP_MM,) * 3, clip)
    grey = masses.tissue_grey(scans.stream(), scans.shape, placed)
    power = echo_power.averaged(scans.stream(), placed, grid, grey, METHOD.dynamic_range_db, clip)
    places = rigid.apply(power.volume.world_from_voxel, np.argwhere(power.seen)[:, ::-1].astype(float))
    values, outside = power.volume.voxels[power.seen], np.full((len(hidden), len(places)), np.inf, np.float32)
    for distance, thing in zip(outside, hidden, strict=True):
        low, high = thing.mesh.bounds
        near = ((places > low - SHELL_MM) & (places < high + SHELL_MM)).all(axis=1)
        distance[near] = signed_distances(places[near], thing.mesh)
    tissue = (outside > 0).all(axis=0)
    levels = np.full(len(hidden), np.nan)
    for k, distance in enumerate(outside):
        inside, shell = values[distance <= 0], values[(distance <= SHELL_MM) & tissue]
        if len(inside) and len(shell):
            levels[k] = 10 * np.log10(max(inside.mean(), LEAST_POWER) / max(shell.mean(), LEAST_POWER))
    return levels


def pairs_of(way: int, hidden: Sequence[Thing], levels: Array, scans: Scans, skin: trimesh.Trimesh) -> list[Pair]:
    """A pair of each true mass, of levels : (n,) dB, by what the software finds in B-scans taken one way."""
    if not hidden:
        return []
    said = masses_step.find(scans, METHOD, skin)
    rested, face_row = said.scans or scans, 0.0 if scans.probe is None else scans.probe.face_row
    places = rested.world_from_pixel, rested.shape, without(hidden, rested)
    where = insonation.of_sweep(*places, spread=METHOD.spreads, face_row=face_row, dynamic_range_db=METHOD.dynamic_range_db)
    uneven_db = said.figures.get("tissue_uneven_db", np.nan)
    middles, sizes = np.array([thing.mesh.center_mass for thing in hidden]), [ball_mm(thing.mesh) for thing in hidden]
    given = detectability.features_at(where, middles, sizes, np.abs(levels), levels > 0, uneven_db)
    pairs = list[Pair]()
    for n, one in enumerate(sweep_errors.compare(list(said.meshes.values()), hidden)):
        volume = np.nan if one.found is None else float(one.found.volume / one.true.volume - 1)
        found = one.centre_error_mm <= WHOLE.centre * sizes[n] / 2 and abs(volume) <= WHOLE.volume
        came = {"centre_error_mm": one.centre_error_mm, "volume_error_percent": 100 * volume, "found": found}
        features = {name: float(column[n]) for name, column in given._asdict().items()}
        pairs.append(Pair(way, sizes[n], float(abs(levels[n])), uneven_db, **features, **came))
    return pairs


def without(hidden: Sequence[Thing], scans: Scans) -> Iterator[NDArray[np.uint8]]:
    """B-scans : n times (h, w) with tissue in place of masses: where these are large and dark they would count as shadows."""
    placed, sound = scans.world_from_pixel, Sound(scans.speed_m_s, scans.speed_m_s)
    grey = np.uint8(masses.tissue_grey(scans.stream(), scans.shape, placed))
    inside = masses.shown([Mass(thing.mesh) for thing in hidden], placed, scans.shape, sound)
    return (np.where(one, grey, image) for one, image in zip(inside, scans.stream(), strict=True))


def ball_mm(body: trimesh.Trimesh) -> float:
    """Diameter, mm, of a ball of a body's volume."""
    return float(np.cbrt(6 / np.pi * body.volume))


def figures(pairs: Sequence[Pair]) -> Metrics:
    """Columns of all pairs, their number, those found, those expected by the coefficients in use, and the Brier score."""
    columns = {f"pair{n:02d}_{name}": float(value) for n, pair in enumerate(pairs) for name, value in pair._asdict().items()}
    found = np.array([pair.found for pair in pairs])
    chance = np.array([float(detectability.probability(pair.features, pair.calibration)) for pair in pairs])
    brier = float(np.mean((chance - found) ** 2)) if pairs else 0.0
    return {"pairs": len(pairs), "found": int(found.sum()), "expected": float(chance.sum()), "brier": brier, **columns}


KINDS = {
    "silicone": Kind(silicone, mass_trial.PATH, mass_trial.CLOCKS, mass_trial.TISSUE_M_S, set_levels),
    "patients": Kind(
        patient,
        patient_trial.PATH.model_copy(update={"standoff_mm": 0.0}),  # she keeps still, and doesn't yield
        patient_trial.CLOCKS,
        patient_trial.TISSUE_M_S,
        shown_levels,
    ),
}
"""by the names of `experiment_runs.SeenTissue`"""

EXPERIMENT = Experiment(
    ("rig.probe", "ultrasound", "seen"), measure, {"found": "expected", "brier": ""}, "expected", counts=("pairs", "found")
)
