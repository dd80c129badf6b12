"""The calibration board: black discs in OpenCV's asymmetric layout, as geometry, so that their edges are crisp.

The white ground has round holes and each disc fills one, sharing its vertices, so nothing overlaps. Board frame: x to the
right, y down, z away from the viewer, origin at the first circle.
"""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial import Delaunay

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.geometry import rigid
from recon.model.rig import Fraction, NotNegative, Part, Positive, Vector
from scenes import solid_meshes
from scenes.noise import Seed
from scenes.scene_types import Material, Scene, Thing

Array = rigid.Array

SIDES = 256  # of a disc's outline: a radius of 4.5 mm is met within 0.0004 mm
CELL_MM = 4.0  # of the ground's triangles, small enough to follow a warp
MAX_ERRORS = 4  # standard deviations that a print error reaches in x and in y; room for them is kept between circles


Stretch = Annotated[float, Field(ge=-0.01, le=0.01)]


class Config(Part):
    """The board's print and pose."""

    columns: Annotated[int, Field(ge=2, le=20)] = 4  # circles a row, as OpenCV counts them
    rows: Annotated[int, Field(ge=2, le=30)] = 11
    spacing_mm: Positive = 15.0  # between rows; circles of a row stand two spacings apart
    diameter_mm: Positive = 9.0
    margin_mm: Positive = 12.0  # white beyond the outermost centres
    centre_mm: Vector = (4.0, -2.0, 660.0)  # the middle of the circles in the world
    rotation_deg: Vector = (0.0, 0.0, 90.0)  # rotation vector, axis times angle; 90 about z lays the board along x
    warp_mm: NotNegative = 0.0  # amplitude of a saddle: the long edges bow back by this, the short ones forward
    bow_mm: Vector = (0.0, 0.0, 0.0)  # besides: an arch along x, a twist, an arch along y; in middles of edges and in corners
    print_error_mm: Annotated[float, Field(ge=0, le=1)] = 0.0  # standard deviation of each centre, in x and in y
    stretch: tuple[Stretch, Stretch, Stretch] = (0.0, 0.0, 0.0)  # of the print: its scale, its length over its width, and shear
    spread_mm: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0  # by which ink makes discs wider than diameter_mm
    white: Fraction = 0.75  # reflectance of paper
    black: Fraction = 0.05  # reflectance of printed ink
    roughness: Annotated[float, Field(gt=0, le=1)] | None = None  # GGX alpha of a glossy coat, which glares; None is matt
    seed: Seed = 1  # of the print errors

    @model_validator(mode="after")
    def _fits(self) -> "Config":
        printed, off = self.diameter_mm + self.spread_mm, MAX_ERRORS * self.print_error_mm
        if printed <= 0:
            raise ValueError(
                f"spread_mm: expected more than {-self.diameter_mm:g}, that discs are left, found {self.spread_mm:g}"
            )
        stretched = float(np.abs(self.stretch).sum())
        nearest = np.sqrt(2) * (self.spacing_mm * (1 - stretched) - 2 * off)  # two centres, along the diagonal
        room = nearest / (1 + np.sin(np.pi / SIDES) / 2)  # leaves half a side of the outline between two discs
        if printed >= room:
            raise ValueError(f"diameter_mm: expected less than {room:.4g} to keep circles apart, found {printed:g} as printed")
        moved = stretched * float(np.max(_middle(self)))
        if printed / 2 + moved + off + self.print_error_mm >= self.margin_mm:
            raise ValueError(f"margin_mm: expected more than half of diameter_mm, found {self.margin_mm:g}")
        return self


class Print(NamedTuple):
    """Black discs on a white ground that may bow, for compiled code; in the board's frame, mm."""

    centres: Array  # (n, 2)
    radius: float
    middle: Array  # (2,) of the ground
    half: Array  # (2,) its half sides
    bow: Array  # (3,) z of the front face by x^2, x y and y^2, with x and y from the middle in half sides


def design(config: Config) -> AsymmetricCircles:
    """The board as designed: all that a calibration is given."""
    return AsymmetricCircles(
        columns=config.columns, rows=config.rows, spacing_mm=config.spacing_mm, diameter_mm=config.diameter_mm
    )


def printed_centres(config: Config) -> Array:
    """Centres of the circles as printed on the warped board : (columns * rows, 3) mm in the board's frame, in OpenCV's order."""
    centres = _printed(config)
    return np.column_stack([centres, _heights(config, centres)])


def printed(config: Config) -> Print:
    """The print by formulas, of which `things` are the mesh."""
    middle = _middle(config)
    return Print(_printed(config), _radius(config), middle, middle + config.margin_mm, _bow(config))


def circle_centres(config: Config) -> Array:
    """Centres of the circles as printed on the warped board : (columns * rows, 3) mm in the world, in the same order."""
    return rigid.apply(world_from_board(config), printed_centres(config))


def world_from_board(config: Config) -> Array:
    """The board's pose : (4, 4)."""
    place = rigid.from_rotation_vector(np.deg2rad(config.rotation_deg), (0, 0, 0))
    place[:3, 3] = np.array(config.centre_mm) - place[:3, :3] @ np.append(_middle(config), 0)
    return place


def build(config: Config) -> Scene:
    """The white ground and the black discs. There is no shape to fit: see `circle_centres`."""
    world = world_from_board(config)
    return Scene("board", tuple(replace(thing, mesh=solid_meshes.moved(thing.mesh, world)) for thing in things(config)))


def things(config: Config) -> tuple[Thing, Thing]:
    """Ground and discs in the board's frame."""
    points, triangles, black = _print(config)
    parts = []
    thickness_mm = 3.0
    for name, chosen, reflectance in (("ground", ~black, config.white), ("discs", black, config.black)):
        used, faces = np.unique(triangles[chosen], return_inverse=True)
        part = points[used]
        mesh = solid_meshes.slab(part, faces.reshape(-1, 3), thickness_mm, _heights(config, part))
        parts.append(Thing(name, mesh, Material(reflectance, config.roughness), smooth=False))
    return parts[0], parts[1]


def _printed(config: Config) -> Array:
    errors = np.random.default_rng(config.seed).standard_normal((config.rows * config.columns, 2))
    errors = np.clip(errors, -MAX_ERRORS, MAX_ERRORS)
    scale, along, shear = config.stretch
    stretched = (1 + scale) * np.eye(2) + np.array([[along, shear], [shear, -along]]) / 2
    middle = _middle(config)
    return (design(config).points()[:, :2] - middle) @ stretched + middle + config.print_error_mm * errors


def _middle(config: Config) -> Array:
    return np.array([2 * config.columns - 1, config.rows - 1]) * config.spacing_mm / 2


def _radius(config: Config) -> float:
    return (config.diameter_mm + config.spread_mm) / 2


def _bow(config: Config) -> Array:
    return np.array(config.bow_mm) + config.warp_mm * np.array([1.0, 0.0, -1.0])


def _heights(config: Config, points: Array) -> Array:
    half = _middle(config) + config.margin_mm
    x, y = ((points - _middle(config)) / half).T
    return np.stack([x**2, x * y, y**2], axis=-1) @ _bow(config)


def _print(config: Config) -> tuple[Array, solid_meshes.Faces, np.ndarray]:
    """Triangulate the board: points (n, 2) mm, triangles (m, 3), whether each is black (m,).

    No point lies nearer to a side of a disc than half that side's length, so a Delaunay triangulation keeps all the sides.
    """
    centres, radius = _printed(config), _radius(config)
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    circle = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    inner = 0.5 * circle[:: SIDES // 32]
    discs = (centres[:, None] + np.concatenate([circle, inner, [[0.0, 0.0]]])).reshape(-1, 2)

    size = 2 * (_middle(config) + config.margin_mm)
    cells = np.ceil(size / CELL_MM).astype(int)
    ground = solid_meshes.grid(tuple(size), tuple(cells))[0] + _middle(config)
    apart = np.linalg.norm(ground[:, None] - centres, axis=-1).min(axis=1) > 1.1 * radius
    points = np.concatenate([ground[apart], discs])

    triangles = Delaunay(points).simplices.astype(np.int64)
    middles = points[triangles].mean(axis=1)
    black = np.linalg.norm(middles[:, None] - centres, axis=-1).min(axis=1) < radius * np.cos(np.pi / SIDES)
    return points, _anticlockwise(points, triangles), black


def _anticlockwise(points: Array, triangles: solid_meshes.Faces) -> solid_meshes.Faces:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    negative = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.where(negative[:, None], triangles[:, ::-1], triangles)
