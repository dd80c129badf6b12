"""Conditions of a session: those of theory, or a laboratory's lamp, prints, skin, hands, brackets, sound and drift."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.model import circle_layout
from recon.model.rig import Part, Rig, Target
from scenes.kinds import board
from scenes.noise import smooth_noise
from scenes.scene_types import Scene, Thing
from twin import tremor
from twin.tremor import Tremor

Array = NDArray[np.float64]

MOST = 4  # standard deviations of a print's errors
# streams of random numbers, apart from those of rendering and of the sensor
STREAM, PRINT_STREAM, BOARD_STREAM = 7, 8, 9
TREMOR_STREAM, TRIGGER_STREAM, BRACKET_STREAM, SOUND_STREAM, DRIFT_STREAM, GEL_STREAM = 10, 11, 12, 13, 14, 15
GEL_EDGE = 0.15  # of the standard deviation of the field whose highest parts are gel: over which it thins out


class Frames(Part):
    """Standard deviations of errors that each frame of a sequence has anew, the same for all devices."""

    flicker: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # of the projector's light, relative
    stray_dn: Annotated[float, Field(ge=0, le=20)] = 0.0  # of light from elsewhere, in 8-bit digital numbers
    shift: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # of grey fringes' phase shifts, in steps of their sequence


class Print(Part):
    """Standard deviations of errors that the probe's target was printed with."""

    place_mm: Annotated[float, Field(ge=0, le=5)] = 0.0  # of each circle along each axis
    diameter_mm: Annotated[float, Field(ge=0, le=5)] = 0.0  # of all outer rims alike: ink spreads


class BoardPrint(Part):
    """Standard deviations of errors that a calibration board has, by its print, its ground and its handling."""

    place_mm: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # of each disc along each axis
    stretch: Annotated[float, Field(ge=0, le=0.002)] = 0.0  # of the print: of its scale, of its aspect and of its shear
    diameter_mm: Annotated[float, Field(ge=0, le=0.1)] = 0.0  # of all discs alike
    bow_mm: Annotated[float, Field(ge=0, le=2)] = 0.0  # of an arch along each side, and of a twist
    flex_mm: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # by which each of these differs from pose to pose


class Skin(Part):
    """A translucent surface as it is: skin or silicone."""

    spread_mm: Annotated[float, Field(ge=0, le=3)] = 0.0  # length of light's spread beneath it
    wet: Annotated[float, Field(ge=0, le=1)] = 0.0  # share of it with gel
    patch_mm: Annotated[float, Field(ge=2, le=200)] = 25.0  # size of the patches of gel


class Motion(Part):
    """Standard deviations of what hands, brackets and triggers do, in each axis where there are several."""

    tremor_mm: Annotated[float, Field(ge=0, le=5)] = 0.0  # of the hand's shift, of 8 to 12 Hz
    tremor_deg: Annotated[float, Field(ge=0, le=5)] = 0.0  # of its turn
    trigger_s: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # of each camera's exposure, in each pair of frames
    bracket_mm: Annotated[float, Field(ge=0, le=5)] = 0.0  # of the probe's shift against its target, from first to last image
    bracket_deg: Annotated[float, Field(ge=0, le=5)] = 0.0  # of its turn


class Sound(Part):
    """Standard deviations of speeds of sound."""

    tissue: Annotated[float, Field(ge=0, le=0.05)] = 0.0  # of all tissues together, relative
    water_c: Annotated[float, Field(ge=0, le=5)] = 0.0  # of the water's temperature, deg C


class Drift(Part):
    """Standard deviations by which cameras and projector differ from what they were when they were calibrated."""

    centre_px: Annotated[float, Field(ge=0, le=5)] = 0.0  # of each principal point along each axis, own pixels
    focal: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # of each focal length, relative


class Conditions(Part):
    """The conditions of a session, see `conf/conditions`."""

    frames: Frames = Frames()
    target: Print = Print()
    board: BoardPrint = BoardPrint()
    skin: Skin = Skin()
    motion: Motion = Motion()
    sound: Sound = Sound()
    drift: Drift = Drift()


IDEAL = Conditions()


class FrameDraw(NamedTuple):
    """Errors of the n frames of a sequence."""

    gain: Array  # (n,) of the projector's light
    stray_dn: Array  # (n,) 8-bit DN
    shift: Array  # (n,) steps


def draw(frames: Frames, count: int, *key: int) -> FrameDraw:
    """Draw the errors of some frames, the same for the same key."""
    normal = np.random.default_rng([*key, STREAM]).standard_normal((3, count))
    return FrameDraw(1 + frames.flicker * normal[0], frames.stray_dn * normal[1], frames.shift * normal[2])


def printed(target: Target, errors: Print, *key: int) -> Target:
    """Draw the target that comes of a design, the same for the same key; ink that spreads narrows the holes, too."""
    if errors == Print():
        return target
    rng = np.random.default_rng([*key, PRINT_STREAM])
    wider = errors.diameter_mm * rng.standard_normal()
    scatter = circle_layout.length_covariance(target.model_copy(update={"tolerance_mm": errors.place_mm, "covariance_mm2": None}))
    target = circle_layout.with_lengths(target, rng.multivariate_normal(circle_layout.lengths(target), scatter))
    outer, inner = target.outer_diameter_mm + wider, target.inner_diameter_mm - wider
    return target.model_copy(update={"outer_diameter_mm": outer, "inner_diameter_mm": inner})


def printed_board(design: board.Config, errors: BoardPrint, *key: int) -> board.Config:
    """Draw the board that comes of a design, the same for the same key, with errors of print drawn anew.

    Stretch, bow and spread that the design has by itself stay.
    """
    if errors == BoardPrint():
        return design
    rng = np.random.default_rng([*key, BOARD_STREAM])
    stretch, wider = rng.standard_normal(3).clip(-MOST, MOST), float(np.clip(rng.standard_normal(), -MOST, MOST))
    changed = {
        "print_error_mm": float(np.hypot(design.print_error_mm, errors.place_mm)),
        "stretch": tuple((np.array(design.stretch) + errors.stretch * stretch).tolist()),
        "spread_mm": design.spread_mm + errors.diameter_mm * wider,
        "bow_mm": tuple((np.array(design.bow_mm) + errors.bow_mm * rng.standard_normal(3)).tolist()),
        "seed": int(rng.integers(2**31)) if errors.place_mm else design.seed,
    }
    return design.model_copy(update=changed)


def as_skin(scene: Scene, skin: Skin, *key: int) -> Scene:
    """A scene whose translucent things let light spread and have patches of gel, the same for the same key."""
    if skin == Skin():
        return scene
    rng = np.random.default_rng([*key, GEL_STREAM])
    return replace(
        scene, things=tuple(_as_skin(thing, skin, rng) if thing.material.translucent else thing for thing in scene.things)
    )


def _as_skin(thing: Thing, skin: Skin, rng: np.random.Generator) -> Thing:
    wet = _patches(np.asarray(thing.mesh.vertices), skin, rng) if skin.wet else None
    return replace(thing, material=replace(thing.material, spread_mm=skin.spread_mm), wet=wet)


def _patches(vertices: Array, skin: Skin, rng: np.random.Generator) -> NDArray[np.float32]:
    """Share of gel at vertices : (n, 3), as (n,); all of the skin has it if all is wet."""
    if skin.wet == 1:
        return np.ones(len(vertices), np.float32)
    field = smooth_noise(vertices, 2 * skin.patch_mm, rng)
    return np.float32(np.clip((field - np.quantile(field, 1 - skin.wet)) / GEL_EDGE + 0.5, 0, 1))


def trembling(errors: Motion, *key: int) -> Tremor:
    """Draw a hand's tremor, the same for the same key."""
    return tremor.draw(errors.tremor_deg, errors.tremor_mm, *key, TREMOR_STREAM)


def triggered(errors: Motion, count: int, *key: int) -> Array:
    """Draw by how much later each camera exposes : (count, 2) s, the same for the same key."""
    return errors.trigger_s * np.random.default_rng([*key, TRIGGER_STREAM]).standard_normal((count, 2))


def given(errors: Motion, moments: NDArray[np.int64], *key: int) -> Array:
    """Draw a bracket's giving at moments : (n,) ns, as (n, 6) rad and mm, 0 in the middle, the same for the same key."""
    size = np.repeat([np.deg2rad(errors.bracket_deg), errors.bracket_mm], 3)
    growth = size * np.random.default_rng([*key, BRACKET_STREAM]).standard_normal(6)
    return ((moments - moments[0]) / max(moments[-1] - moments[0], 1) - 0.5)[:, None] * growth


def speeds(errors: Sound, *key: int) -> tuple[float, float]:
    """Draw the true speed in tissue over the usual one, and the water's temperature less the usual one in deg C."""
    tissue, warmer = np.random.default_rng([*key, SOUND_STREAM]).standard_normal(2).clip(-MOST, MOST).tolist()
    return 1 + errors.tissue * tissue, errors.water_c * warmer


def drifted(rig: Rig, errors: Drift, *key: int) -> Rig:
    """Draw the rig as it is in use, some time after its calibration, the same for the same key."""
    if errors == Drift():
        return rig
    rng = np.random.default_rng([*key, DRIFT_STREAM])
    changed = {}
    for name in ("cam1", "cam2", "projector"):
        device, (x, y, longer) = getattr(rig, name), rng.standard_normal(3).tolist()
        (cx, cy), (fx, fy), ratio = device.optics.centre_px, device.optics.focal_px, 1 + errors.focal * longer
        optics = device.optics.model_copy(
            update={
                "centre_px": (cx + errors.centre_px * x, cy + errors.centre_px * y),
                "focal_px": (fx * ratio, fy * ratio),
            }
        )
        changed[name] = device.model_copy(update={"optics": optics})
    return rig.model_copy(update=changed)


def in_use(rig: Rig, life: Conditions, seed: int) -> Rig:
    """Draw the rig as it is in use: its devices have drifted, and the targets of all bodies are as they were printed."""
    bodies = {name: printed(target, life.target, seed, number) for number, (name, target) in enumerate(rig.bodies.items(), 1)}
    targets = {"target": printed(rig.target, life.target, seed), "bodies": bodies}
    return drifted(rig, life.drift, seed).model_copy(update=targets)


def check_board(design: board.Config, errors: BoardPrint) -> None:
    """Refuse errors by which a drawn board may have discs that touch, or leave it.

    Raises
    ------
    ValueError
        In the worst case that is drawn.
    """
    stretch = [value + float(np.sign(value or 1)) * MOST * errors.stretch for value in design.stretch]
    spreads = [design.spread_mm + side * MOST * errors.diameter_mm for side in (-1, 1)]
    for spread in spreads:
        worst = {
            "print_error_mm": float(np.hypot(design.print_error_mm, errors.place_mm)),
            "stretch": stretch,
            "spread_mm": spread,
        }
        board.Config.model_validate(design.model_dump() | worst)


def flexed(printed: board.Config, errors: BoardPrint, *key: int) -> board.Config:
    """Draw the same board as it is bent in one pose."""
    if errors.flex_mm == 0:
        return printed
    bent = errors.flex_mm * np.random.default_rng([*key, BOARD_STREAM]).standard_normal(3)
    return printed.model_copy(update={"bow_mm": tuple((np.array(printed.bow_mm) + bent).tolist())})
