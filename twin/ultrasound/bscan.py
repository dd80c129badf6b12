"""B-scans of a scene, from poses: the front door of the B-mode model."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.threads import mapped
from twin.displacement import Displacement
from twin.ultrasound import bmode_image
from twin.ultrasound.aperture_paths import over_aperture
from twin.ultrasound.beam import beam
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.medium import scatter
from twin.ultrasound.sound_paths import Paths, follow
from twin.ultrasound.surface_echoes import surface_echoes, wire_echoes
from twin.ultrasound.tool_echoes import Tool, tool_echoes
from twin.ultrasound.tool_shadow import shaded
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scan:
    """A B-scan, and its intermediate results."""

    image: NDArray[np.uint8]  # (h, w)
    envelope: NDArray[np.float32]  # (rows, lines), of a linear array (h, w), after the gain; 1 is the reference tissue
    paths: Paths


def scan(
    scene: Body, transducer: Transducer, world_from_image: Array, seed: int, frame: int = 0, tools: Sequence[Tool] = ()
) -> Scan:
    """Take a B-scan.

    Parameters
    ----------
    scene : Body
        Of `twin.ultrasound.echo_solids.body(scene)`, built once.
    world_from_image : (4, 4) mm
        Rigid: where the image plane stands; x along the array, y into the depth, origin at pixel (0, 0): on the face of a linear
        array; a curved one begins in the first row.
    seed : int
        Of the tissue: the same from every pose.
    frame : int
        Number of the image, which seeds the electronic noise.
    tools : sequence of Tool
        Where they are at that moment; each shades the tissue and the other tools.
    """
    envelope, paths = _envelope(scene, transducer, world_from_image, seed, frame, tools)
    return Scan(bmode_image.image(bmode_image.shown(envelope, transducer), transducer), envelope, paths)


def _envelope(
    scene: Body, transducer: Transducer, world_from_image: Array, seed: int, frame: int, tools: Sequence[Tool]
) -> tuple[NDArray[np.float32], Paths]:
    spread = beam(transducer)
    clear = over_aperture(follow(scene, transducer, world_from_image), scene, transducer, world_from_image)
    near = [tool for tool in tools if tool.is_near(transducer, world_from_image)]
    paths = shaded(clear, near, transducer, world_from_image) if near else clear
    echoes = scatter(scene, transducer, spread, paths, world_from_image, seed)
    echoes += surface_echoes(scene, transducer, spread, paths, world_from_image, seed)
    if scene.wires:
        echoes += wire_echoes(scene, transducer, spread, paths, world_from_image, seed)
    for tool in near:
        others = [other for other in near if other is not tool]
        lit = shaded(clear, others, transducer, world_from_image) if others else clear
        echoes += tool_echoes(tool, scene, transducer, spread, lit, world_from_image)
    return bmode_image.envelope(echoes, transducer, spread, paths, np.random.default_rng([seed, frame])), paths


def scans(
    scene: Body,
    transducer: Transducer,
    world_from_image: Array,
    seed: int,
    tools: Sequence[Sequence[Tool]] | None = None,
    displaced: Callable[[int], Displacement] | None = None,
) -> Iterator[Scan]:
    """Take the B-scans of poses : (n, 4, 4) mm, numbered from 0, one a thread at a time; see `scan`.

    Parameters
    ----------
    tools : (n,) of each image
    displaced : by which the scene has moved from its rest, by the image's number
    """
    poses = np.asarray(world_from_image)
    led = [()] * len(poses) if tools is None else tools
    kept: NDArray[np.float32] | None = None  # of the picture before
    share = np.float32(transducer.picture.persistence)

    def take(pose: Array, frame: int, there: Sequence[Tool]) -> tuple[NDArray[np.float32], NDArray[np.float32], Paths]:
        lying = scene if displaced is None else scene.displaced(displaced(frame))
        envelope, paths = _envelope(lying, transducer, pose, seed, frame, there)
        return bmode_image.shown(envelope, transducer), envelope, paths

    leap_mm = 5.0  # from one B-scan to the next, after which nothing of that before is kept
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1) if len(poses) else []
    for step, (shown, envelope, paths) in zip(steps, mapped(take, poses, range(len(poses)), led), strict=True):
        kept = shown if kept is None or step > leap_mm else share * kept + (1 - share) * shown
        yield Scan(bmode_image.image(kept, transducer), envelope, paths)
