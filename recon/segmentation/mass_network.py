"""The network that tells masses from the tissue of a breast in single B-scans, by their look; run by ONNX Runtime.

Grown tissue is as uneven as masses are: lobules of fat are dark bodies, too, and only their looks tell them apart. The network
was trained on the twin's patients alone, see docs/training.md.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import threads
from recon.errors import InputError, reason
from recon.freehand.volume_compounding import Clip, Grid
from recon.segmentation import echo_power
from recon.segmentation.echo_power import EchoPower, Placed

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Shapes = dict[str, tuple[int | None, ...]]

WEIGHTS = Path(__file__).parent / "weights" / "masses.onnx"
PIXEL_MM = 0.4  # of what the network sees: masses from 6 mm on are 15 px and more, and speckle is averaged
GROWN_DB = 2.5  # unevenness of tissue from which looks count: clinical images of silicone have 2.2, breasts 2.75 and more
MULTIPLE = 16  # px, of its heights and widths
INTERFACE: tuple[Shapes, Shapes] = ({"scan": (None, 1, None, None)}, {"mask": (None, 1, None, None)})


class Network(Protocol):
    """A network as ONNX Runtime runs it."""

    def run(self, names: Any, given: Any, /) -> Sequence[Any]:
        """Answers of some names, of what is given by names."""
        ...


@dataclass(frozen=True)
class Looks:
    """When masses are told from tissue by their looks, and by which network."""

    when: Literal["auto", "always", "never"] = "auto"  # auto: in tissue that is as uneven as a breast
    network: Network | None = None  # the one that comes with the software

    def sees(self, uneven_db: float) -> bool:
        """Whether they count, in tissue whose power has a standard deviation."""
        return self.when == "always" or (self.when == "auto" and uneven_db >= GROWN_DB)


def opened(path: Path = WEIGHTS) -> Network:
    """The network of a file.

    Raises
    ------
    InputError
        If the file is missing, isn't a network, or another one, such as of one size of images.
    """
    from recon.tracking import networks  # its runtime takes a tenth of a second to import, which most steps have no use for

    session = networks.session(path, INTERFACE, threads=1)
    for height, width in ((MULTIPLE, 2 * MULTIPLE), (3 * MULTIPLE, MULTIPLE)):
        scan = np.zeros((1, 1, height, width), np.float32)
        try:
            (logits,) = session.run(["mask"], {"scan": scan})
        except networks.FAULTS as error:
            raise InputError(f"{path}: expected a network of B-scans of any size, found {reason(error)}") from None
        if np.shape(logits) != scan.shape:
            found = "x".join(map(str, np.shape(logits)))
            raise InputError(f"{path}: expected an answer for each pixel, 1x1x{height}x{width}, found {found}")
    return session


@cache
def shipped() -> Network:
    """The network that comes with the software."""
    return opened()


def reduced_size(shape: tuple[int, int], pixel_mm: tuple[float, float]) -> tuple[int, int]:
    """Height and width, px of the network's, of a B-scan : (h, w) of some pixel size, width and height in mm."""
    (height, width), (wide_mm, high_mm) = shape, pixel_mm
    return max(round(height * high_mm / PIXEL_MM), 1), max(round(width * wide_mm / PIXEL_MM), 1)


def reduced(image: NDArray[np.uint8], pixel_mm: tuple[float, float]) -> NDArray[np.uint8]:
    """A B-scan : (h, w) of some pixel size, width and height in mm, as the network sees it.

    To the right and below it is black on to the next multiple of its sizes, as beside the B-scans that the network learns from:
    with the edge's pixels there the IoU of two trained networks in patients held out was lower by 0.08.
    """
    high, wide = reduced_size((image.shape[0], image.shape[1]), pixel_mm)
    small = cv2.resize(image, (wide, high), interpolation=cv2.INTER_AREA)
    return np.pad(small, ((0, -high % MULTIPLE), (0, -wide % MULTIPLE)))


def averaged(
    images: Iterable[NDArray[np.uint8]],
    world_from_pixel: Array,
    grid: Grid,
    clip: Clip,
    network: Network | None = None,
) -> EchoPower:
    """Mean probability of a mass on a grid, in place of power: `recon.segmentation.echo_power.averaged`.

    The network isn't asked about B-scans without a pose.
    """
    pixel_mm, session = echo_power.pixel_mm(world_from_pixel), network or shipped()
    placed = set(np.flatnonzero(np.isfinite(world_from_pixel).all(axis=(1, 2))).tolist())
    nothing = Placed(*np.empty((4, 0), np.float32))

    def place(number: int, image: NDArray[np.uint8]) -> Placed:
        if number not in placed:
            return nothing
        chance = _probability(image, pixel_mm, session)
        left, right, top, bottom = clip.bounds(chance.shape)
        v, u = np.mgrid[top : bottom + 1, left : right + 1].astype(np.float32)
        return Placed(np.ascontiguousarray(chance[top : bottom + 1, left : right + 1]), np.ones_like(u), u, v)

    parts = threads.mapped(lambda numbered: place(*numbered), enumerate(images))
    return echo_power.accumulated(parts, world_from_pixel, grid)


def probabilities(
    images: Iterable[NDArray[np.uint8]], pixel_mm: tuple[float, float], network: Network | None = None
) -> Iterator[Map]:
    """Probability of a mass in each pixel of B-scans : n times (h, w), at their own resolution."""
    session = network or shipped()
    return threads.mapped(lambda image: _probability(image, pixel_mm, session), images)


def _probability(image: NDArray[np.uint8], pixel_mm: tuple[float, float], session: Network) -> Map:
    """That of one B-scan : (h, w)."""
    height, width = image.shape
    high, wide = reduced_size((height, width), pixel_mm)
    small = reduced(image, pixel_mm)
    (logits,) = session.run(["mask"], {"scan": small[None, None].astype(np.float32) / 255})
    there = np.asarray(logits)[0, 0, :high, :wide]
    return 1 / (1 + np.exp(-cv2.resize(there, (width, height), interpolation=cv2.INTER_LINEAR)))
