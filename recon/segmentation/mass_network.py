"""The network that tells masses from the tissue of a breast in single B-scans, by their look; run by ONNX Runtime.

Grown tissue is as uneven as masses are: lobules of fat are dark bodies, too, and only their looks tell them apart. The network
was trained on the twin's patients alone, see docs/training.md.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from recon import threads
from recon.freehand.volume_compounding import Clip, Grid
from recon.segmentation import echo_power
from recon.segmentation.echo_power import EchoPower, Placed
from recon.tracking import networks
from recon.tracking.networks import Interface

Array = NDArray[np.float64]
Map = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "masses.onnx"
PIXEL_MM = 0.4  # of what the network sees: masses from 6 mm on are 15 px and more, and speckle is averaged
GROWN_DB = 2.8  # unevenness of tissue from which looks count: clinical images of silicone have 2.2, breasts 3.4 and more
MULTIPLE = 16  # px, of its heights and widths
INTERFACE: Interface = ({"scan": (None, 1, None, None)}, {"mask": (None, 1, None, None)})


@dataclass(frozen=True)
class Looks:
    """When masses are told from tissue by their looks, and by which network."""

    when: Literal["auto", "always", "never"] = "auto"  # auto: in tissue that is as uneven as a breast
    network: onnxruntime.InferenceSession | None = None  # the one that comes with the software

    def sees(self, uneven_db: float) -> bool:
        """Whether they count, in tissue whose power has a standard deviation."""
        return self.when == "always" or (self.when == "auto" and uneven_db >= GROWN_DB)


def opened(path: Path = WEIGHTS) -> onnxruntime.InferenceSession:
    """The network of a file.

    Raises
    ------
    InputError
        If the file is missing, isn't a network, or another one.
    """
    return networks.session(path, INTERFACE, threads=1)


@cache
def shipped() -> onnxruntime.InferenceSession:
    """The network that comes with the software."""
    return opened()


def reduced(image: NDArray[np.uint8], pixel_mm: tuple[float, float]) -> NDArray[np.uint8]:
    """A B-scan : (h, w) of some pixel size, width and height in mm, as the network sees it.

    Black all round on to the next multiple of its sizes, to the right and below.
    """
    height, width = image.shape
    wide, high = (max(round(count * mm / PIXEL_MM), 1) for count, mm in ((width, pixel_mm[0]), (height, pixel_mm[1])))
    small = cv2.resize(image, (wide, high), interpolation=cv2.INTER_AREA)
    return np.pad(small, ((0, -high % MULTIPLE), (0, -wide % MULTIPLE)))


def averaged(
    images: Iterable[NDArray[np.uint8]],
    world_from_pixel: Array,
    grid: Grid,
    clip: Clip,
    network: onnxruntime.InferenceSession | None = None,
) -> EchoPower:
    """Mean probability of a mass on a grid, in place of power: `recon.segmentation.echo_power.averaged`."""
    pixel_mm = echo_power.pixel_mm(world_from_pixel)

    def place(chance: Map) -> Placed:
        left, right, top, bottom = clip.bounds(chance.shape)
        v, u = np.mgrid[top : bottom + 1, left : right + 1].astype(np.float32)
        return Placed(np.ascontiguousarray(chance[top : bottom + 1, left : right + 1]), np.ones_like(u), u, v)

    return echo_power.accumulated(map(place, probabilities(images, pixel_mm, network)), world_from_pixel, grid)


def probabilities(
    images: Iterable[NDArray[np.uint8]], pixel_mm: tuple[float, float], network: onnxruntime.InferenceSession | None = None
) -> Iterator[Map]:
    """Probability of a mass in each pixel of B-scans : n times (h, w), at their own resolution."""
    session = network or shipped()

    def answer(image: NDArray[np.uint8]) -> Map:
        (height, width), small = image.shape, reduced(image, pixel_mm)
        wide, high = (max(round(count * mm / PIXEL_MM), 1) for count, mm in ((width, pixel_mm[0]), (height, pixel_mm[1])))
        (logits,) = session.run(["mask"], {"scan": small[None, None].astype(np.float32) / 255})
        there = np.asarray(logits)[0, 0, :high, :wide]
        return 1 / (1 + np.exp(-cv2.resize(there, (width, height), interpolation=cv2.INTER_LINEAR)))

    return threads.mapped(answer, images)
