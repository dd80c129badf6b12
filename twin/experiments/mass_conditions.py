"""Conditions under which masses of the breast phantom are measured, by name; nothing in the software was tuned to them.

Each is the usual sweep, of two strokes over three tumours, but for what it says. Places, forms, poses and noise are drawn by a
trial's seed, alike under all conditions.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import field_validator
from scipy.optimize import root_scalar

from recon.errors import InputError, did_you_mean
from recon.geometry import rigid
from recon.model.rig import Part
from scenes.kinds import breast
from scenes.kinds.breast import Tumour
from twin.living.living_body import STILL, Living

Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])  # in the phantom's frame
SEED = 700  # of the first breast
EDGE_MM = 1.5  # of the skin's facets
LEAST_MM = 2.0  # of tissue between masses and the skin or the base; spikes reach out
GIVES_MM = 0.5  # by which asked distances may be missed: bodies are measured from vertex to vertex
DRAWN_MM = (3.0, 3.0, 1.0)  # about their places masses are drawn by as much to both sides, in the phantom's frame


USUAL = (
    Tumour(size_mm=27.0, centre_mm=(-14.0, 4.0, 21.0)),
    Tumour(size_mm=14.0, centre_mm=(22.0, 10.0, 24.0)),
    Tumour(size_mm=12.0, centre_mm=(20.0, -17.0, 20.0)),
)
"""of the phantom's sizes, somewhat nearer to its middle than there, so that drawn ones are scanned whole"""


def _usual(**look: Any) -> tuple[Tumour, ...]:
    """The usual masses, of another look."""
    return tuple(one.model_copy(update=look) for one in USUAL)


@dataclass(frozen=True)
class Condition:
    """What is unlike the usual sweep."""

    masses: tuple[Tumour, ...] = USUAL
    breast: Mapping[str, Any] = field(default_factory=dict)  # fields of the scene
    apart_mm: float | None = None  # of tissue between the first two; None: as their places have it
    under_skin_mm: tuple[float, float] | None = None  # least tissue over each, drawn between both; None: likewise
    lost_s: float = 0.0  # for which poses are lost over the largest mass
    every_mm: float = 0.0  # from B-scan to B-scan; 0 leaves all
    share: float = 1.0  # of the sweep, from its start on
    ultrasound: Mapping[str, float] = field(default_factory=dict)  # added to the scanner's fields
    standoff_mm: float = 0.0  # of the path; negative presses
    living: Living = STILL


PAIR = (Tumour(size_mm=14.0, centre_mm=(-20.0, 2.0, 22.0)), Tumour(size_mm=12.0, centre_mm=(-20.0, 2.0, 22.0)))
"""about one place, from which they are moved apart"""
SHALLOW = (Tumour(size_mm=12.0, centre_mm=(-26.0, 6.0, 30.0)), Tumour(size_mm=10.0, centre_mm=(30.0, 14.0, 30.0)))
CYST = {"echo_db": None, "loss_db": 0.05}
PRESSED = Living(yields=True, element_mm=5.0)
FLAT = {"size_mm": (170.0, 130.0, 49.5), "nipple_height_mm": 1.5}
"""a breast whose nipple, 5.5 mm lower, isn't pressed to less than what the twin can show"""

CONDITIONS = {
    "usual": Condition(),
    "gap_0.4s": Condition(lost_s=0.4),
    "gap_1s": Condition(lost_s=1.0),
    "every_3mm": Condition(every_mm=3.0),
    "every_5mm": Condition(every_mm=5.0),
    "first_fifth": Condition(share=0.2),
    "first_half": Condition(share=0.5),
    "first_two_thirds": Condition(share=2 / 3),
    "touching": Condition(PAIR, apart_mm=0.0),
    "near": Condition(PAIR, apart_mm=1.0),
    "absorbing": Condition(_usual(loss_db=2.0)),
    "spiculated": Condition(_usual(form="spiculated")),
    "irregular": Condition(_usual(form="irregular")),
    "weak": Condition(_usual(echo_db=-3.0)),
    "weaker": Condition(_usual(echo_db=-0.5)),
    "cysts": Condition(_usual(**CYST)),
    "mixed": Condition(tuple(one.model_copy(update=look) for one, look in zip(USUAL, (CYST, {"echo_db": 8.0}, {}), strict=True))),
    "bright": Condition(_usual(echo_db=8.0)),
    "steep_gain": Condition(ultrasound={"tgc_db_per_cm_mhz": -0.5}),
    "noisy": Condition(ultrasound={"noise_db": 15.0}),
    "shallow": Condition(SHALLOW, under_skin_mm=(2.0, 3.0)),
    **{f"small_{size}": Condition(_usual(size_mm=float(size))) for size in (4, 5, 6)},
    **{f"pressed_{by}": Condition(breast=FLAT, standoff_mm=-float(by), living=PRESSED) for by in (1, 2, 3)},
    **{f"breathing_{by}": Condition(living=Living(breathing_mm=float(by))) for by in (2, 5)},
}


class MassCondition(Part):
    """Condition under which masses are measured."""

    condition: str = "usual"  # a name of CONDITIONS

    @field_validator("condition")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in CONDITIONS:
            raise ValueError(f"expected one of {', '.join(CONDITIONS)}, found {name}{did_you_mean(name, list(CONDITIONS))}")
        return name


def scene(condition: Condition, seed: int) -> dict[str, Any]:
    """The breast of a seed, with its masses.

    Raises
    ------
    InputError
        If there is no place for them.
    """
    rng = np.random.default_rng([seed, 49])
    moves = rng.uniform(-1, 1, (len(condition.masses), 3)) * DRAWN_MM
    aside, thick = _level(rng), rng.uniform(*(condition.under_skin_mm or (0.0, 0.0)), len(condition.masses))
    if condition.apart_mm is not None:
        moves[1] = moves[0]
    places = [one.centre_mm + move for one, move in zip(condition.masses, moves, strict=True)]
    fields: dict[str, Any] = {"seed": SEED + seed, "edge_mm": EDGE_MM, **condition.breast}
    config = _placed(breast.Config(tumours=condition.masses, **fields), places)
    least_mm = {"tissue_mm": LEAST_MM}
    if condition.apart_mm is not None:
        config = _parted(config, aside, condition.apart_mm)
        least_mm |= {"apart_mm": condition.apart_mm - GIVES_MM}
    if condition.under_skin_mm is not None:
        config = _raised(config, thick)
        least_mm |= {"tissue_mm": condition.under_skin_mm[0] - GIVES_MM}
    tumours = [one.model_dump(mode="json") for one in config.tumours]
    return {"kind": "breast", **fields, **least_mm, "tumours": tumours}


def _level(rng: np.random.Generator) -> Array:
    """A direction : (3,) within 20 deg of the level, on average in the middle of the others."""
    turn, height = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(-20, 20))
    return np.array([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])


def _placed(config: breast.Config, places: list[Array]) -> breast.Config:
    """The same with masses at places : (3,) mm each."""
    tumours = (
        one.model_copy(update={"centre_mm": tuple(place.tolist())}) for one, place in zip(config.tumours, places, strict=True)
    )
    return config.model_copy(update={"tumours": tuple(tumours)})


def _parted(config: breast.Config, aside: Array, apart_mm: float) -> breast.Config:
    """The same with its first two masses moved apart along a direction : (3,), until there is so much tissue between them."""
    one, other, *_ = breast.bodies_of(config)
    farthest = sum(tumour.size_mm for tumour in config.tumours[:2]) + apart_mm

    def left(way: float) -> float:
        return breast.gap(one, _shifted(other, way * aside)) - apart_mm

    ways = np.arange(farthest, 0, -0.5)  # from afar, as within each other they have no gap that grows evenly
    near = next(way for way in ways if left(way) < 0)
    way = root_scalar(left, bracket=(near, near + 0.5), xtol=1e-3).root
    places = [np.array(tumour.centre_mm) for tumour in config.tumours]
    return _placed(config, [places[0] - way / 2 * aside, places[1] + way / 2 * aside, *places[2:]])


def _raised(config: breast.Config, under_mm: Array) -> breast.Config:
    """The same with masses raised until the least tissue over them is that of (n,) mm."""
    depth, places = breast.depth_in(breast.open_mesh(breast.skin_of(config))), []
    for tumour, body, thick in zip(config.tumours, breast.bodies_of(config), under_mm, strict=True):

        def spare(way: float, body: trimesh.Trimesh = body, thick: float = thick) -> float:
            return float(depth(body.vertices + way * UP).min()) - thick

        low, high = -20.0, 25.0
        if not spare(low) > 0 > spare(high):
            raise InputError(f"masses: expected a place {thick:.1f} mm under the skin about {tumour.centre_mm}, found none")
        places.append(tumour.centre_mm + root_scalar(spare, bracket=(low, high), xtol=1e-3).root * UP)
    return _placed(config, places)


def _shifted(body: trimesh.Trimesh, shift: Array) -> trimesh.Trimesh:
    return body.copy().apply_transform(rigid.transform(np.eye(3), shift))
