"""B-scans of a scene, from poses: the front door of the B-mode model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.threads import mapped
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.medium import scatter
from twin.ultrasound.scan_lines import converted
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
    spread = beam(transducer)
    clear = follow(scene, transducer, world_from_image)
    near = [tool for tool in tools if tool.is_near(transducer, world_from_image)]
    paths = shaded(clear, near, transducer, world_from_image) if near else clear
    echoes = scatter(scene, transducer, spread, paths, world_from_image, seed)
    echoes += surface_echoes(scene, transducer, spread, paths, world_from_image, seed)
    echoes += wire_echoes(scene, transducer, spread, paths, world_from_image, seed)
    for tool in near:
        others = [other for other in near if other is not tool]
        lit = shaded(clear, others, transducer, world_from_image) if others else clear
        echoes += tool_echoes(tool, scene, transducer, spread, lit, world_from_image)
    received = bmode_image.focused(echoes, spread)
    received += bmode_image.noise(transducer, spread, np.random.default_rng([seed, frame]))
    received *= bmode_image.gain_over_depth(transducer, spread).astype(np.float32)[:, None]
    received += bmode_image.face(transducer).astype(np.float32)[:, None]
    envelope = np.abs(received)
    shown = converted(bmode_image.compressed(envelope, transducer), transducer, order=1)
    return Scan(bmode_image.grey(shown, transducer), envelope, paths)


def scans(
    scene: Body, transducer: Transducer, world_from_image: Array, seed: int, tools: Sequence[Sequence[Tool]] | None = None
) -> Iterator[Scan]:
    """Take the B-scans of poses : (n, 4, 4) mm, numbered from 0, one a thread at a time; see `scan`.

    tools : (n,) of each image
    """
    poses = np.asarray(world_from_image)
    led = [()] * len(poses) if tools is None else tools
    return mapped(lambda pose, frame, there: scan(scene, transducer, pose, seed, frame, there), poses, range(len(poses)), led)
