"""The breast phantom: a silicone breast with three lobulated tumours, or others, on a dark table with its apex to the camera.

Skin relief, areola, table and tumours are drawn from a seed; sizes are exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.surface_tree import surface_tree
from recon.model.rig import Finite, Fraction, NotNegative, Part, Positive, Vector
from scenes import solid_meshes
from scenes.acoustics import TISSUES
from scenes.dome import Dome, Form, dome
from scenes.mass_forms import CIRCUMSCRIBED, MassForm, mass
from scenes.noise import Seed, smooth_noise
from scenes.scene_types import Material, Scene, Thing
from scenes.table import table
from scenes.tissue import Tissue

MADE_OF = {"": "gel", "breast": "silicone", "tumour": "tumour", "table": "wood"}  # for ultrasound; see `scenes.acoustics`

Array = rigid.Array
Depth = Callable[[Array], Array]  # of points : (n, 3) below a surface, (n,) mm; negative on the outer side


class Tumour(Part):
    """One tumour: its greatest extent, its middle in the phantom's frame (z up from the base), its form, its look by sound."""

    size_mm: Annotated[float, Field(ge=2, le=80)]
    centre_mm: Vector
    form: MassForm = "lobulated"
    echo_db: Finite | None = -12.0  # backscatter over that of fat; the silicone's is 2; None is free of echoes
    loss_db: NotNegative = 0.9  # dB/cm/MHz; the silicone's is 0.6, and fluid's 0.05: a mass of that without echoes is a cyst

    def tissue(self) -> Tissue | None:
        """What sound meets in it; None of a usual one."""
        tissue = replace(TISSUES["tumour"], echogenicity=self.echo_db, attenuation=self.loss_db)
        return None if tissue == TISSUES["tumour"] else tissue


class Outside(Part):
    """A breast as light sees it: the size of the phantom of Meza et al. 2021. The rest is our choice."""

    size_mm: tuple[Positive, Positive, Positive] = (170.0, 130.0, 55.0)  # length, width, height with the nipple
    middle_mm: tuple[Finite, Finite] = (4.0, -2.0)  # x, y of the footprint's middle in the world
    turn_deg: Finite = 0.0  # about the line of sight
    table_mm: Positive = 700.0  # z of the table's top, or of the chest
    apex_mm: tuple[Finite, Finite] = (11.0, -7.0)  # nipple from the footprint's middle, towards the fuller side
    taper: Annotated[float, Field(ge=-0.4, le=0.4)] = 0.14  # relative change of width from the middle to an end: a teardrop
    fullness: Annotated[float, Field(ge=0, le=0.25)] = 0.12  # swell of the full side, as a part of the way to the rim
    steepness: Annotated[float, Field(ge=0.3, le=0.97)] = 0.86  # 1 would meet the table at a right angle
    nipple_width_mm: Positive = 10.0  # at half height
    nipple_height_mm: Positive = 7.0
    areola_width_mm: Positive = 38.0
    areola_height_mm: NotNegative = 0.8
    montgomery_bumps: Annotated[int, Field(ge=0, le=40)] = 9
    unevenness_mm: Annotated[float, Field(ge=0, le=2)] = 0.5  # standard deviation of the slow irregularity, over some 70 mm
    relief_mm: Annotated[float, Field(ge=0, le=0.2)] = 0.03  # standard deviation of the skin's texture, over 3 to 9 mm
    edge_mm: Annotated[float, Field(ge=0.3, le=5)] = 0.75  # of a facet
    reflectance: Fraction = 0.45
    areola_reflectance: Fraction = 0.27
    nipple_reflectance: Fraction = 0.23
    roughness: Annotated[float, Field(gt=0, le=1)] = 0.38
    ior: Annotated[float, Field(ge=1, le=3)] = 1.4
    seed: Seed = 7

    @model_validator(mode="after")
    def _proportions(self) -> "Outside":
        length, width, height = self.size_mm
        if self.nipple_height_mm + self.areola_height_mm >= height / 2:
            raise ValueError(
                f"nipple_height_mm: expected less than half the height of {height:g}, found {self.nipple_height_mm:g}"
            )
        if self.nipple_width_mm >= 0.6 * self.areola_width_mm:
            raise ValueError(f"nipple_width_mm: expected less than 0.6 of areola_width_mm, found {self.nipple_width_mm:g}")
        if np.hypot(self.apex_mm[0] / length, self.apex_mm[1] / width) > 0.15:
            raise ValueError(f"apex_mm: expected within 0.15 of size_mm from the middle, found {self.apex_mm}")
        if self.areola_width_mm > 0.45 * min(length, width):
            raise ValueError(f"areola_width_mm: expected up to {0.45 * min(length, width):g}, found {self.areola_width_mm:g}")
        return self


class Config(Outside):
    """The phantom of Meza et al. 2021: 170 x 130 x 55 mm with tumours of 27, 14 and 12 mm."""

    tumours: tuple[Tumour, ...] = (
        Tumour(size_mm=27.0, centre_mm=(-14.0, 6.0, 20.0)),
        Tumour(size_mm=14.0, centre_mm=(24.0, 16.0, 24.0)),
        Tumour(size_mm=12.0, centre_mm=(22.0, -22.0, 19.0)),
    )
    tissue_mm: NotNegative = 5.0  # least tissue between a tumour and the skin or the base
    apart_mm: Annotated[float, Field(ge=-5, le=50)] = 1.0  # the same between two; below 0 they may reach so far into each other


def build(config: Config) -> Scene:
    """Breast, tumours (inside) and table.

    Raises
    ------
    InputError
        If a tumour lies too near to the skin, to the base or to another tumour.
    """
    skin, bodies, (_, colour_rng, _) = skin_of(config), bodies_of(config), _streams(config)
    depth_below, middles = depth_in(open_mesh(skin)), [one.centre_mm for one in config.tumours]
    for k, body in enumerate(bodies):
        check_depth(f"tumours.{k}", body, depth_below, config.tissue_mm)
        _check_apart(bodies[: k + 1], config.apart_mm)
        check_middles("tumours", middles, bodies[: k + 1])

    world = world_from_phantom(config)
    material = Material(config.reflectance, config.roughness, config.ior, translucent=True)
    things = [Thing("breast", solid_meshes.moved(closed(skin), world), material, albedo(config, skin, colour_rng))]
    for k, (wanted, body) in enumerate(zip(config.tumours, bodies, strict=True)):
        placed, even = solid_meshes.moved(body, world), wanted.form in CIRCUMSCRIBED
        own = wanted.tissue()
        things.append(Thing(f"tumour{k}", placed, Material(config.reflectance), inside=True, tissue=own, mirrors=even))
    return Scene("breast", (*things, table(config.table_mm, config.seed)))


def skin_of(config: Config) -> Dome:
    """The skin that its seed gives, in the phantom's frame."""
    return dome(form_of(config), _streams(config)[0])


def bodies_of(config: Config) -> list[trimesh.Trimesh]:
    """Its tumours, in the phantom's frame."""
    streams = _streams(config)[2].spawn(len(config.tumours))
    return [
        solid_meshes.moved(mass(wanted.form, wanted.size_mm, rng), rigid.transform(np.eye(3), wanted.centre_mm))
        for wanted, rng in zip(config.tumours, streams, strict=True)
    ]


def _streams(config: Config) -> list[np.random.Generator]:
    """Random numbers of skin, colour and tumours."""
    return np.random.default_rng(config.seed).spawn(3)


def world_from_phantom(config: Outside) -> Array:
    """The phantom's pose : (4, 4), its base on the table and its z axis towards the camera."""
    upright = Rotation.from_euler("xz", (180, config.turn_deg), degrees=True)
    return rigid.transform(upright.as_matrix(), (*config.middle_mm, config.table_mm))


def closed(skin: Dome) -> trimesh.Trimesh:
    """The dome closed by a flat base, fanned from its middle; the base's middle is the last vertex."""
    middle = len(skin.vertices)
    rim = np.arange(middle - skin.rim, middle)
    base = np.stack([np.roll(rim, -1), rim, np.full(skin.rim, middle)], axis=1)
    vertices = np.concatenate([skin.vertices, [[0, 0, 0]]])
    return trimesh.Trimesh(vertices, np.concatenate([skin.faces, base]), process=False)


def form_of(config: Outside) -> Form:
    """The numbers that shape its dome."""
    return Form(
        size=config.size_mm,
        apex=config.apex_mm,
        taper=config.taper,
        fullness=config.fullness,
        steepness=config.steepness,
        nipple_width=config.nipple_width_mm,
        nipple_height=config.nipple_height_mm,
        areola_width=config.areola_width_mm,
        areola_height=config.areola_height_mm,
        montgomery_bumps=config.montgomery_bumps,
        unevenness=config.unevenness_mm,
        relief=config.relief_mm,
        edge=config.edge_mm,
    )


def albedo(config: Outside, skin: Dome, rng: np.random.Generator) -> NDArray[np.float32]:
    """Reflectance of the closed mesh's vertices : skin, darker areola and nipple, paler Montgomery bumps, slightly mottled."""
    mottle = 1 + 0.02 * smooth_noise(skin.vertices, 25, rng) + 0.015 * smooth_noise(skin.vertices, 5, rng)
    areola = np.clip(skin.areola * (1 + 0.12 * smooth_noise(skin.vertices, 4, rng)), 0, 1)
    value = config.reflectance + areola * (config.areola_reflectance - config.reflectance)
    value += skin.nipple * (config.nipple_reflectance - config.areola_reflectance)
    value += 0.3 * skin.bumps * (config.reflectance - value)
    return np.clip(np.append(mottle * value, config.reflectance), 0, 1).astype(np.float32)


def check_depth(name: str, mass: trimesh.Trimesh, below_skin: Depth, least_mm: float) -> None:
    """Refuse a mass that has less than `least_mm` of tissue to the skin or the base, or lies outside; InputError."""
    if (tissue := least_tissue(mass, below_skin)) < least_mm:
        raise InputError(f"{name}: expected at least {least_mm:g} mm of tissue to skin and base, found {tissue:.2f} mm")


def least_tissue(mass: trimesh.Trimesh, below_skin: Depth) -> float:
    """Least tissue, mm, between a mass and the skin or the base; negative where it reaches out."""
    return float(min(below_skin(mass.vertices).min(), mass.vertices[:, 2].min()))


def check_middles(name: str, middles: Sequence[ArrayLike], bodies: Sequence[trimesh.Trimesh]) -> None:
    """Refuse the last of some masses if its middle lies in an earlier one, or one's in it: they may touch, but hide no other."""
    last = len(bodies) - 1
    for other in range(last):
        pairs = ((middles[last], bodies[other]), (middles[other], bodies[last]))
        inside_mm = max(depth(np.array([middle]), body)[0] for middle, body in pairs)
        if inside_mm > 0:
            expected = f"expected its middle outside of {name}.{other}, and that one's outside of it"
            raise InputError(f"{name}.{last}: {expected}, found one {inside_mm:.1f} mm within")


def _check_apart(bodies: Sequence[trimesh.Trimesh], apart_mm: float) -> None:
    """Refuse the last of some tumours if it comes nearer than `apart_mm` to an earlier one, or one lies within the other."""
    last = len(bodies) - 1
    for other in range(last):
        if (found := gap(bodies[last], bodies[other])) < apart_mm:
            raise InputError(f"tumours.{last}: expected at least {apart_mm:g} mm from tumours.{other}, found {found:.2f} mm")


def gap(one: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Least tissue between two bodies, mm; below 0 by how far one reaches into the other."""
    return -float(max(depth(one.vertices, other).max(), depth(other.vertices, one).max()))


def depth(points: Array, surface: trimesh.Trimesh) -> Array:
    """Distance of points : (n, 3) to a surface's nearest vertex : (n,) mm, positive on the inner side."""
    return depth_in(surface)(points)


def depth_in(surface: trimesh.Trimesh) -> Depth:
    """As `depth`, of one surface for points again and again."""
    vertices, normals, tree = surface.vertices.view(np.ndarray), surface.vertex_normals, surface_tree(surface.vertices)

    def depth(points: Array) -> Array:
        distance, nearest = tree.query(points)
        outwards = ((points - vertices[nearest]) * normals[nearest]).sum(axis=1) > 0
        return np.where(outwards, -distance, distance)

    return depth


def open_mesh(skin: Dome) -> trimesh.Trimesh:
    """The dome without a base."""
    return trimesh.Trimesh(skin.vertices, skin.faces, process=False)
