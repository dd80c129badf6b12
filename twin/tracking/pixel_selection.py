"""Selection of camera pixels to render, and images made of them: views, full frames, patches, sketches."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.tracking.moving_transport import NO_CIRCLE, Lanes

Grey = NDArray[np.uint8]
Whole = NDArray[np.int64]

VIEW = (320, 240)  # width, height of what the detector sees
PATCH = 120
HALF = 59  # px from a patch's first pixel to its middle one


class Picture(Protocol):
    """Pixels to render, and the image that their numbers make."""

    def lanes(self, take: int, camera: int) -> Lanes:
        """The pixels of one camera of one take of the batch."""
        ...

    def image(self, numbers: Grey) -> Grey:
        """The image, from the numbers of `lanes`."""
        ...


@dataclass(frozen=True)
class View:
    """A camera image as OpenCV's linear interpolation would shrink it; only the four pixels that it takes are rendered."""

    size: tuple[int, int]  # of the camera image
    samples: int  # rays a camera pixel

    def lanes(self, take: int, camera: int) -> Lanes:
        """The camera pixels : (2 * 240 * 2 * 320,); the four of a view's pixel share one set of sample points."""
        u, v = self.taps()
        v, u = np.broadcast_arrays(v[:, :, None, None], u[None, None])
        _, y, _, x = np.indices(u.shape, np.uint32)
        one_of_four = np.arange(2)[:, None, None, None] * 2 + np.arange(2)[None, None, :, None]
        first = np.broadcast_to(one_of_four * self.samples, u.shape)
        return lanes_of(take, camera, u, v, self.samples, y * VIEW[0] + x, first)

    def image(self, numbers: Grey) -> Grey:
        """The view : (240, 320), made by OpenCV, to the last bit as from a whole image."""
        return cv2.resize(self.spread(numbers), VIEW)

    def spread(self, numbers: Grey) -> Grey:
        """An image : (h, w) of the camera's size, in which the pixels not rendered repeat their neighbours."""
        u, v = self.taps()
        taps = numbers.reshape(2, VIEW[1], 2, VIEW[0]).transpose(1, 0, 3, 2).reshape(2 * VIEW[1], 2 * VIEW[0])
        width, height = self.size
        return taps[np.ix_(_nearest(v.T.ravel(), height), _nearest(u.T.ravel(), width))]

    def taps(self) -> tuple[Whole, Whole]:
        """Camera pixels that make a view's: along u : (2, 320), and along v : (2, 240)."""
        return _taps(self.size[0], VIEW[0]), _taps(self.size[1], VIEW[1])


def _taps(full: int, view: int) -> Whole:
    first = np.floor((np.arange(view) + 0.5) * full / view - 0.5).astype(int)
    return np.clip([first, first + 1], 0, full - 1)


def _nearest(places: Whole, count: int) -> Whole:
    """Number of the place nearest to each of 0 to count - 1, for places in order."""
    between = (places[1:] + places[:-1]) / 2
    return np.searchsorted(between, np.arange(count))


@dataclass(frozen=True)
class Window:
    """A rectangle of a camera image; pixels beyond the image repeat its border."""

    size: tuple[int, int]  # of the camera image
    first: tuple[int, int]  # its upper left pixel
    extent: tuple[int, int]  # width, height
    samples: int
    sets: int = 0  # numbers the windows of one image, so that their sample points differ
    circle: int = NO_CIRCLE

    def lanes(self, take: int, camera: int) -> Lanes:
        """The pixels, row by row."""
        v, u = np.mgrid[: self.extent[1], : self.extent[0]] + np.array(self.first[::-1])[:, None, None]
        u, v = np.clip(u, 0, self.size[0] - 1), np.clip(v, 0, self.size[1] - 1)
        sets = (self.sets + 1) << 24 | np.arange(u.size).reshape(u.shape)
        return lanes_of(take, camera, u, v, self.samples, sets, circle=self.circle)

    def image(self, numbers: Grey) -> Grey:
        """The window : (height, width)."""
        return numbers.reshape(self.extent[::-1])


def full_frame(size: tuple[int, int], samples: int) -> Window:
    """The whole camera image."""
    return Window(size, (0, 0), size, samples)


@dataclass(frozen=True)
class Sketch:
    """A camera image rendered in part: the pixels that make its view, and one window in full.

    Shrunk to a view it is what the full image would be; the window is the full image's; all else repeats the pixels rendered
    next to it. For tests of a tracker that looks at the view and then at windows about the target, at a fraction of the cost.
    """

    view: View
    window: Window

    def lanes(self, take: int, camera: int) -> Lanes:
        """The pixels of both."""
        both = self.view.lanes(take, camera), self.window.lanes(take, camera)
        return joined(both)

    def image(self, numbers: Grey) -> Grey:
        """The full image : (h, w)."""
        count = 4 * VIEW[0] * VIEW[1]
        image = self.view.spread(numbers[:count])
        width, height = self.view.size
        (u0, v0), (w, h) = self.window.first, self.window.extent
        inside = np.s_[max(v0, 0) : max(v0 + h, 0), max(u0, 0) : max(u0 + w, 0)]
        piece = self.window.image(numbers[count:])[max(-v0, 0) : height - v0, max(-u0, 0) : width - u0]
        image[inside] = piece
        return image


def lanes_of(take: int, camera: int, u, v, samples: int, sets, first=0, circle: int = NO_CIRCLE) -> Lanes:
    """Lanes for pixels u, v of one camera; `sets` and `first` as in `Lanes`."""
    same = np.ones(u.size, np.uint32)
    firsts = np.broadcast_to(np.asarray(first, np.uint32), u.shape).ravel()
    sets = np.asarray(sets, np.uint32).ravel()
    return Lanes(
        same * take, same * camera, np.float32(u).ravel(), np.float32(v).ravel(), same * samples, sets, firsts, same * circle
    )


def joined(blocks) -> Lanes:
    """Lanes one after the other."""
    return Lanes(*(np.concatenate([getattr(block, name) for block in blocks]) for name in Lanes.__dataclass_fields__))
