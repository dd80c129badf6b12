"""Types of a scene: meshes with materials, and the ground-truth primitives to fit against.

World is the frame of camera 1, lengths in mm: z points away from the camera into the scene, x right and y down in the image.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry.primitives import Shape, Sphere
from scenes.tissue import Tissue


@dataclass(frozen=True)
class Material:
    """Reflection of a surface at the projector's wavelength (525 nm): a diffuse body, perhaps under a glossy coat.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    reflectance: float  # diffuse albedo, 0 to 1
    roughness: float | None = None  # GGX alpha of a dielectric coat (rough plastic); None is purely diffuse
    ior: float = 1.5  # refractive index of the coat
    translucent: bool = False  # skin or silicone: under conditions of life light spreads beneath it, and gel wets it
    spread_mm: float = 0.0  # length of that spread, see `twin.optics.light_spread`; 0 is opaque

    def __post_init__(self) -> None:
        if not 0 <= self.reflectance <= 1:
            raise ValueError(f"reflectance: expected 0 to 1, found {self.reflectance}")
        if self.roughness is not None and not 0 < self.roughness <= 1:
            raise ValueError(f"roughness: expected more than 0, up to 1, found {self.roughness}")
        if not self.ior >= 1:
            raise ValueError(f"ior: expected at least 1, found {self.ior}")
        if not self.spread_mm >= 0:
            raise ValueError(f"spread_mm: expected 0 or more, found {self.spread_mm}")


@dataclass(frozen=True, eq=False)
class Thing:
    """A closed body in the world.

    Raises
    ------
    ValueError
        If `albedo` or `wet` doesn't have one value from 0 to 1 for each vertex.
    """

    name: str
    mesh: trimesh.Trimesh  # in the world, mm, watertight, normals outwards
    material: Material
    albedo: NDArray[np.float32] | None = None  # (n_vertices,), replaces material.reflectance where given
    wet: NDArray[np.float32] | None = None  # (n_vertices,), share of the coat that is gel
    smooth: bool = True  # interpolated vertex normals (curved), or flat faces
    inside: bool = False  # hidden within another thing: optics leave it out, ultrasound sees it
    tissue: Tissue | None = None  # for ultrasound; else its name tells it, see `scenes.acoustics`
    mirrors: bool = True  # for ultrasound: whether its border is even enough for an echo of its own
    primitive: Sphere | None = None  # the exact shape that the mesh approximates, for a renderer that has one

    def __post_init__(self) -> None:
        for kind, values in (("albedo", self.albedo), ("wet", self.wet)):
            if values is None:
                continue
            if values.shape != (len(self.mesh.vertices),):
                raise ValueError(f"{self.name}: {kind}: expected {len(self.mesh.vertices)} values, found shape {values.shape}")
            if not ((values >= 0) & (values <= 1)).all():
                raise ValueError(f"{self.name}: {kind}: expected values from 0 to 1")


@dataclass(frozen=True, eq=False)
class Layer:
    """A tissue inside a scene's things, by its signed distance on a grid: grown from fields, too fine for meshes."""

    name: str
    distance: NDArray[np.float32]  # (nx, ny, nz) mm, negative inside; of a sheet, its sides have two signs
    half_mm: float = 0.0  # half the thickness of a sheet; 0 of what is no sheet
    mirrors: bool = False  # whether its border is as even as a mirror; other borders send no echo of their own


@dataclass(frozen=True, eq=False)
class Layers:
    """Layers in the world, on one grid: the first holds the others, of which the later ones count; all count over `within`."""

    within: str  # name of the last thing that holds them; those after it count over them
    origin: NDArray[np.float64]  # (3,) mm in the world, of the first grid point
    step_mm: float
    layers: tuple[Layer, ...]
    uneven_db: NDArray[np.float32]  # (nx, ny, nz) backscatter over its tissue's
    strata_mm: NDArray[np.float32]  # (nx, ny, nz) place across the strands of tissue, which lie along its level faces


@dataclass(frozen=True, eq=False)
class Scene:
    """Things in front of the rig, and the shapes that measurements of them are fitted with."""

    name: str
    things: tuple[Thing, ...]
    shapes: tuple[Shape, ...] = ()
    layers: Callable[[], Layers] | None = None  # grows them for ultrasound, which takes seconds; the same each time
    filled: Mapping[str, Any] = field(default_factory=dict)  # fields that weren't given, under `drawn` or `usual`, for the truth
