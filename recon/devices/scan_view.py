"""The B-scan within what a scanner sends: its part of the image, turned and scaled.

Orientations are PLUS's: the directions of the transducer in which x and y grow. M is towards the marked side of its array, U away
from it, F away from its face, N towards it. MF has the marked side at the right and depth down; PLUS itself sends MF.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError, Size

TURNS = {"MF": (1, 1), "UF": (1, -1), "MN": (-1, 1), "UN": (-1, -1)}  # steps along v and u that turn one into MF
ORIENTATIONS = (*TURNS, *(name[::-1] for name in TURNS))  # those with lines of sound in rows are transposed before


@dataclass(frozen=True)
class ScanView:
    """Crop, then orientation, then scale. DeviceError if one is none."""

    crop: tuple[int, int, int, int] | None = None  # u, v of the upper left pixel, width, height, px of what is sent
    orientation: str = "MF"  # of what is sent
    scale: float = 1.0  # px of the B-scan for one that is sent

    def __post_init__(self) -> None:
        if self.orientation not in ORIENTATIONS:
            raise DeviceError(f"orientation: expected one of {', '.join(ORIENTATIONS)}, found {self.orientation!r}")
        scales = (0.05, 4.0)
        if not scales[0] <= self.scale <= scales[1]:
            raise DeviceError(f"scale: expected {scales[0]} to {scales[1]}, found {self.scale:g}")
        if self.crop and (min(self.crop) < 0 or 0 in self.crop[2:]):
            raise DeviceError(f"crop: expected u and v from 0 on and a width and a height, found {list(self.crop)}")

    def size(self, sent: Size) -> Size:
        """Width and height of the B-scan, of those that are sent; DeviceError if the crop lies outside."""
        u, v, width, height = self.crop or (0, 0, *sent)
        if u + width > sent[0] or v + height > sent[1]:
            raise DeviceError(f"crop: expected a part of the image of {sent[0]}x{sent[1]} px, found {list(self.crop or ())}")
        wide, tall = (width, height) if self.orientation in TURNS else (height, width)
        return max(round(self.scale * wide), 1), max(round(self.scale * tall), 1)

    def of(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The B-scan : (h, w) in an image of `size(...)`; where nothing is to be done, the image itself."""
        size = self.size((image.shape[1], image.shape[0]))
        if self.crop:
            u, v, width, height = self.crop
            image = image[v : v + height, u : u + width]
        across = self.orientation not in TURNS
        down, right = TURNS[self.orientation[::-1] if across else self.orientation]
        turned = (image.T if across else image)[::down, ::right]
        if self.scale == 1:
            return np.ascontiguousarray(turned)
        method = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(np.ascontiguousarray(turned), size, interpolation=method), np.uint8)
