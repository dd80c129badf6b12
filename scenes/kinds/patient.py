"""A patient on her back: a breast grown from a seed, on a chest with muscle, ribs and lung, and masses as radiologists say.

Masses lie in what has grown as they are: touching, in clusters, in gland or fat, but none about another's middle. The skin is
that of the breast phantom.
"""

from functools import partial
from typing import Annotated, Literal, get_args

import numpy as np
import trimesh
from pydantic import Field, field_validator

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.rig import Fraction, NotNegative, Part, Positive, Vector
from scenes import solid_meshes
from scenes.anatomy import Anatomy, grow, in_world
from scenes.dome import Dome, dome
from scenes.kinds.breast import (
    Outside,
    albedo,
    check_depth,
    check_middles,
    closed,
    depth_in,
    form_of,
    least_tissue,
    open_mesh,
    world_from_phantom,
)
from scenes.mass_forms import CIRCUMSCRIBED, MassForm, mass
from scenes.scene_types import Layer, Layers, Material, Scene, Thing
from scenes.tissue import Tissue
from scenes.tumour import caliper

MADE_OF = {  # for ultrasound; see `scenes.acoustics`
    "": "gel",
    "breast": "skin",
    "chest": "muscle",
    **{name: name for name in ("fat", "ligament", "gland", "duct", "nipple", "muscle", "fascia", "lung")},
    "rib": "bone",
    "mass": "tumour",  # but for a tissue of its own
    "solid": "tumour",
}
Pattern = Literal["anechoic", "hypoechoic", "isoechoic", "hyperechoic", "complex"]
Behind = Literal["none", "enhancement", "shadow"]

ECHOES: dict[Pattern, float | None] = {
    "anechoic": None,
    "hypoechoic": -8.0,
    "isoechoic": 0.0,
    "hyperechoic": 8.0,
    "complex": None,
}
"""dB over fat, the reference of BI-RADS; carcinomas and fibroadenomas of Nam et al. 2013 lie 2 to 12 dB below the gland"""
LOSSES: dict[Behind, float] = {"none": 0.8, "enhancement": 0.3, "shadow": 1.6}
"""dB/cm/MHz; what lies above and beside a mass loses some 0.75"""
FLAT: dict[MassForm, float] = {"round": 0.92, "oval": 0.7, "lobulated": 0.75, "irregular": 0.9, "spiculated": 1.0}
"""height over what the form would have: benign masses lie along the tissue's planes, wider than tall; shares assumed"""
MODULI: dict[Pattern, float] = {"anechoic": 1.0, "hypoechoic": 16.0, "isoechoic": 6.4, "hyperechoic": 3.25, "complex": 2.0}
"""kPa: carcinomas 10 to 42, fibroadenomas 6.4 [Samani et al. 2007]; cysts assumed, lipomas as fat"""
SPEEDS: dict[Pattern, float] = {
    "anechoic": 1530.0,
    "hypoechoic": 1550.0,
    "isoechoic": 1530.0,
    "hyperechoic": 1470.0,
    "complex": 1530.0,
}
"""m/s: cysts 1530, carcinomas 1548 to 1570, fibroadenomas about 1530, lipomas as fat [Li et al. 2022]"""


FORMS: tuple[MassForm, ...] = ("round", "oval", "lobulated", "irregular", "spiculated")
"""of masses that are drawn"""
COMMON: tuple[Pattern, ...] = ("anechoic", "hypoechoic", "hypoechoic", "hyperechoic")
"""patterns of drawn ones with an even border, but for round ones, which are cysts; others are hypoechoic"""
PATTERNS, BEHIND = get_args(Pattern), get_args(Behind)
BEHIND_DARK: tuple[Behind, ...] = ("none", "shadow")
"""what lies behind drawn hypoechoic ones"""


class Mass(Part):
    """One mass, by the words of BI-RADS."""

    size_mm: Annotated[float, Field(ge=2, le=80)]
    """greatest extent"""
    centre_mm: Vector
    """middle in the breast's frame, z up from the chest"""
    form: MassForm = "oval"
    pattern: Pattern = "hypoechoic"
    """echoes over those of fat; `complex` is a cyst with a solid part"""
    behind: Behind = "none"
    """what lies behind it"""
    calcified: bool = False
    """specks of 0.2 mm, 20 a cm3"""

    def tissue(self) -> Tissue:
        """What sound meets in it."""
        loss = 0.05 if self.pattern in ("anechoic", "complex") and self.behind != "shadow" else LOSSES[self.behind]
        speed = SPEEDS[self.pattern]
        density = 1.0 if self.pattern in ("anechoic", "complex") else 1.04
        specks = 0.02 if self.calcified else 0.0
        return Tissue(
            1e-3 * density * speed,
            speed,
            loss,
            ECHOES[self.pattern],
            0.012,
            soft=True,
            specks_per_mm3=specks,
            modulus_kpa=MODULI[self.pattern],
        )


USUAL = (
    Mass(size_mm=19.0, centre_mm=(-16.0, 8.0, 25.0), form="spiculated", behind="shadow", calcified=True),
    Mass(size_mm=14.0, centre_mm=(26.0, 18.0, 22.0), form="oval", pattern="anechoic", behind="enhancement"),
    Mass(size_mm=11.0, centre_mm=(24.0, -24.0, 20.0), form="lobulated"),
)
"""masses where none are given: a cancer, a cyst and a fibroadenoma"""


class DrawnMasses(Part):
    """How many masses are drawn, how large, where their middles may lie in the breast's frame, and of which kinds."""

    count: tuple[Annotated[int, Field(ge=0, le=20)], Annotated[int, Field(ge=0, le=20)]] = (2, 3)
    """fewest and most: some to be told apart, with room between them"""
    size_mm: tuple[Annotated[float, Field(ge=2, le=80)], Annotated[float, Field(ge=2, le=80)]] = (8.0, 20.0)
    """least and most greatest extent: cancers of stage T1 are up to 20; the least assumed"""
    beside_mm: tuple[Positive, Positive] = (38.0, 26.0)
    """along x and y, to both sides; beyond, the usual breast has no room for most"""
    above_mm: tuple[Positive, Positive] = (14.0, 38.0)
    """over the chest: nearly all that is free in the usual breast, which is 52 high"""
    apart_mm: NotNegative = 3.0
    """at least, between spheres of their sizes about two: none touch in B-scans; assumed"""
    any_words: bool = False
    """whether any form may have any echoes and anything behind it, or only those that are usual together"""
    tries: Annotated[int, Field(ge=1, le=100_000)] = 200
    """until there is said to be no room; at most 8 were needed in 40 usual breasts, 52 in small ones"""

    @field_validator("count", "size_mm", "above_mm")
    @classmethod
    def _ordered(cls, pair: tuple[float, float]) -> tuple[float, float]:
        if pair[0] > pair[1]:
            raise ValueError(f"expected the least and the most, found {pair[0]:g} and {pair[1]:g}")
        return pair


class Config(Outside):
    """A patient's breast: its outside, its anatomy and its masses."""

    size_mm: tuple[Positive, Positive, Positive] = (165.0, 140.0, 52.0)
    areola_height_mm: NotNegative = 0.5
    nipple_height_mm: Positive = 5.0
    roughness: Annotated[float, Field(gt=0, le=1)] = 0.45
    anatomy: Anatomy = Anatomy()
    masses: tuple[Mass, ...] | Literal["drawn"] | None = None
    """each by hand, or drawn by the seed; if not given, the usual three, or drawn ones in each of many sweeps"""
    least_mm: Annotated[float, Field(ge=0, le=20)] = 2.0
    """of tissue between a mass and the skin or the chest"""
    drawn: DrawnMasses = DrawnMasses()
    chest_reflectance: Fraction = 0.45


def build(config: Config) -> Scene:
    """Breast, masses (inside) and chest, with the layers that have grown in them.

    Raises
    ------
    InputError
        If a mass lies too near to the skin or to the chest, or outside, or one has another's middle in it.
    """
    skin, (_, colour_rng, mass_rng) = skin_of(config), _streams(config)
    if config.masses == "drawn":
        masses, by = draw_masses(config, skin, np.random.default_rng([config.seed, 2])), "drawn"
    else:
        masses, by = (USUAL, "usual") if config.masses is None else (config.masses, "")
    world = world_from_phantom(config)
    material = Material(config.reflectance, config.roughness, config.ior, translucent=True)
    things = [
        Thing(
            "chest",
            solid_meshes.moved(_chest(), world),
            Material(config.chest_reflectance, config.roughness, config.ior, True),
            smooth=False,
        ),
        Thing("breast", solid_meshes.moved(closed(skin), world), material, albedo(config, skin, colour_rng)),
    ]
    bodies, below_skin = list[trimesh.Trimesh](), depth_in(open_mesh(skin))
    for k, (wanted, rng) in enumerate(zip(masses, mass_rng.spawn(len(masses)), strict=True)):
        body = _lying(wanted, rng)
        check_depth(f"masses.{k}", body, below_skin, config.least_mm)
        bodies.append(body)
        check_middles("masses", [one.centre_mm for one in masses], bodies)
        placed, even = solid_meshes.moved(body, world), wanted.form in CIRCUMSCRIBED
        things.append(Thing(f"mass{k}", placed, Material(0.3), inside=True, tissue=wanted.tissue(), mirrors=even))
        if wanted.pattern == "complex":
            things.append(_solid_part(f"solid{k}", wanted, rng, world))
    layers = partial(_layers, config.anatomy, skin, config.seed, world)
    filled = {by: {"masses": [one.model_dump(mode="json") for one in masses]}} if by else {}
    return Scene("patient", tuple(things), layers=layers, filled=filled)


def skin_of(config: Config) -> Dome:
    """The skin that grows from its seed, in the breast's frame."""
    return dome(form_of(config), _streams(config)[0])


def draw_masses(config: Config, skin: Dome, rng: np.random.Generator) -> tuple[Mass, ...]:
    """Draw masses, apart from each other, as `config.drawn` says.

    Raises
    ------
    InputError
        If no place is found for them.
    """
    limits, masses, below_skin = config.drawn, list[Mass](), depth_in(open_mesh(skin))
    wanted = int(rng.integers(*limits.count, endpoint=True))
    (x, y), (lowest, highest) = limits.beside_mm, limits.above_mm
    for _ in range(limits.tries):
        if len(masses) == wanted:
            break
        size, form = float(rng.uniform(*limits.size_mm)), FORMS[rng.integers(len(FORMS))]
        centre = rng.uniform([-x, -y, lowest], [x, y, highest])
        pattern: Pattern = "hypoechoic"
        if form == "round":
            pattern = "anechoic"
        elif form in CIRCUMSCRIBED:
            pattern = COMMON[rng.integers(len(COMMON))]
        dark = BEHIND_DARK[rng.integers(len(BEHIND_DARK))]
        behind: Behind = "enhancement" if pattern == "anechoic" else dark if pattern == "hypoechoic" else "none"
        if limits.any_words:
            pattern, behind = PATTERNS[rng.integers(len(PATTERNS))], BEHIND[rng.integers(len(BEHIND))]
        one = Mass(size_mm=size, centre_mm=tuple(centre.tolist()), form=form, pattern=pattern, behind=behind)
        if any(np.linalg.norm(centre - other.centre_mm) < (size + other.size_mm) / 2 + limits.apart_mm for other in masses):
            continue
        body = _lying(one, _streams(config)[2].spawn(len(masses) + 1)[-1])
        if least_tissue(body, below_skin) >= config.least_mm:
            masses.append(one)
    if len(masses) < wanted:
        raise InputError(f"masses: expected room for {wanted} drawn ones, found it for {len(masses)}; give them, or another seed")
    return tuple(masses)


def _streams(config: Config) -> list[np.random.Generator]:
    """Random numbers of skin, colour and masses."""
    return np.random.default_rng(config.seed).spawn(3)


def _lying(wanted: Mass, rng: np.random.Generator) -> trimesh.Trimesh:
    """A mass in its place, in the breast's frame."""
    flat = _flattened(mass(wanted.form, wanted.size_mm, rng), FLAT[wanted.form])
    return solid_meshes.moved(flat, rigid.transform(np.eye(3), wanted.centre_mm))


def _flattened(body: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    """A mass of a height over its own, of the same greatest extent."""
    vertices = body.vertices * [1, 1, height]
    return trimesh.Trimesh(vertices * (caliper(body.vertices) / caliper(vertices)), body.faces, process=False)


def _solid_part(name: str, wanted: Mass, rng: np.random.Generator, world: rigid.Array) -> Thing:
    """The solid part of a complex cyst: beside its middle, of 0.4 of its size."""
    aside = rng.standard_normal(3)
    centre = wanted.centre_mm + 0.12 * wanted.size_mm * aside / np.linalg.norm(aside)
    body = solid_meshes.moved(mass("irregular", 0.4 * wanted.size_mm, rng), rigid.transform(np.eye(3), centre))
    tissue = wanted.model_copy(update={"pattern": "isoechoic"}).tissue()
    return Thing(name, solid_meshes.moved(body, world), Material(0.3), inside=True, tissue=tissue)


def _chest() -> trimesh.Trimesh:
    """The chest around and below the breast, its surface in z = 0."""
    size_mm, thick_mm = (420.0, 340.0), 60.0
    plate = solid_meshes.slab(*solid_meshes.grid(size_mm, (60, 48)), thick_mm)
    return solid_meshes.moved(plate, np.diag([1.0, -1.0, -1.0, 1.0]))


def _layers(anatomy: Anatomy, skin: Dome, seed: int, world: rigid.Array) -> Layers:
    layers, grown = [], grow(anatomy, skin, np.random.default_rng([seed, 1]))
    for layer in grown.layers:
        distance, _ = in_world(layer.distance, grown.grid, world)
        layers.append(Layer(layer.name, distance, layer.half_mm, layer.mirrors))
    uneven, origin = in_world(grown.uneven_db, grown.grid, world)
    strata, _ = in_world(grown.strata_mm, grown.grid, world)
    return Layers("breast", origin, grown.grid.step, tuple(layers), uneven, strata)
