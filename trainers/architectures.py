"""The networks of the tracker, as published with the published names of their weights, and smaller ones of ours; one for masses.

A detector takes grey/255 (n, 1, h, w), h and w multiples of 8, and gives logits of where a circle's centre is, (n, 65, h/8, w/8):
pixel 8 row + column of a cell, or 64 for none; and of which circle it is, (n, circles + 1, h/8, w/8): c0, c1 and on, or none. A
segmenter takes patches (n, 1, h, w), h and w multiples of 8, and gives logits (n, 1, h, w) of the filled outer disc at the middle
of each. `masses` takes B-scans (n, 1, h, w), h and w multiples of 16, and gives logits (n, 1, h, w) of a mass at each pixel.

Source of the published ones: Meza et al. 2021, MarkerPose; the detector's layout is that of DeTone et al. 2018, SuperPoint.
"""

import math
from collections import OrderedDict
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

Name = Literal["detector", "segmenter", "published_detector", "published_segmenter", "masses"]

PIXELS, NO_PIXEL = 65, 64  # classes of a cell: its 64 pixels, and none
CELL = 8  # px, edge of a cell
CELLS_A_CIRCLE = 200  # about, in what a detector trains with


def network(name: Name, circles: int) -> nn.Module:
    """A network with fresh weights, from torch's global generator, for a target of some circles."""
    if not is_detector(name):
        return {"segmenter": Segmenter, "published_segmenter": PublishedSegmenter, "masses": MassSegmenter}[name]()
    module = {"detector": Detector, "published_detector": PublishedDetector}[name](circles=circles)
    begin_with_nothing(module.get_parameter("convD.3.bias" if name.startswith("published") else "detection.3.bias"))
    return module


def begin_with_nothing(bias: nn.Parameter) -> None:
    """Set a detector's bias (65,) for cells that show nothing, as most do; else the first hundred steps learn just this."""
    with torch.no_grad():
        bias[NO_PIXEL] = math.log(NO_PIXEL * CELLS_A_CIRCLE)


def is_detector(name: Name) -> bool:
    """Whether a network finds circles in a view; the others find one in a patch."""
    return name.endswith("detector")


class DoubleConv(nn.Module):
    """Twice: a convolution over 3x3, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, middle: int | None = None) -> None:
        super().__init__()
        middle = middle or outputs
        self.double_conv = nn.Sequential(*_convolution(inputs, middle), *_convolution(middle, outputs))

    def forward(self, image: Tensor) -> Tensor:
        """(n, inputs, h, w) to (n, outputs, h, w)."""
        return self.double_conv(image)


class PublishedDetector(nn.Module):
    """The published detector."""

    def __init__(self, circles: int) -> None:
        super().__init__()
        self.conv1 = DoubleConv(1, 64)
        self.conv2 = DoubleConv(64, 64)
        self.conv3 = DoubleConv(64, 128)
        self.conv4 = DoubleConv(128, 128)
        self.convD = nn.Sequential(*_convolution(128, 256), nn.Conv2d(256, PIXELS, 1))
        self.convC = nn.Sequential(*_convolution(128, 256), nn.Conv2d(256, circles + 1, 1))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 1, h, w) to logits (n, 65, h/8, w/8) of the place and (n, circles + 1, h/8, w/8) of the identity."""
        features = self.conv1(image)
        for stage in (self.conv2, self.conv3, self.conv4):
            features = stage(max_pool2d(features, 2))
        return self.convD(features), self.convC(features)


class PublishedSegmenter(nn.Module):
    """The published segmenter, a U-Net."""

    def __init__(self, first: int = 16) -> None:
        super().__init__()
        self.inc = DoubleConv(1, first)
        self.down1 = DoubleConv(first, 2 * first)
        self.down2 = DoubleConv(2 * first, 4 * first)
        self.down3 = DoubleConv(4 * first, 4 * first)
        self.up1 = DoubleConv(8 * first, 2 * first, 4 * first)
        self.up2 = DoubleConv(4 * first, first, 2 * first)
        self.up3 = DoubleConv(2 * first, first)
        self.outc = nn.Conv2d(first, 1, 1)

    def forward(self, patch: Tensor) -> Tensor:
        """(n, 1, h, w) to logits of the same shape."""
        levels = [self.inc(patch)]
        for stage in (self.down1, self.down2, self.down3):
            levels.append(stage(max_pool2d(levels[-1], 2)))
        features = levels.pop()
        for stage in (self.up1, self.up2, self.up3):
            features = stage(torch.cat([_doubled(features), levels.pop()], 1))
        return self.outc(features)


class Residual(nn.Module):
    """Two dilated convolutions over 3x3 beside a way straight through."""

    def __init__(self, channels: int, dilations: tuple[int, int]) -> None:
        super().__init__()
        first, second = dilations
        self.body = nn.Sequential(
            *_convolution(channels, channels, dilation=first), *_convolution(channels, channels, dilation=second)[:2]
        )

    def forward(self, features: Tensor) -> Tensor:
        """(n, channels, h, w) to the same shape."""
        return torch.relu(features + self.body(features))


class Detector(nn.Module):
    """Ours: strided at the entry, then dilated at 1/8 of the resolution.

    Its field of view reaches 15 cells to each side, 120 px: the whole target from each circle, as one circle looks like another.
    """

    def __init__(self, circles: int, channels: int = 80) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            *_convolution(1, 16, stride=2),
            *_convolution(16, 48, stride=2),
            *_convolution(48, channels, stride=2),
        )
        self.trunk = nn.Sequential(*(Residual(channels, dilations) for dilations in ((1, 2), (4, 4), (2, 1))))
        self.detection = nn.Sequential(*_convolution(channels, channels, 1), nn.Conv2d(channels, PIXELS, 1))
        self.identity = nn.Sequential(*_convolution(channels, channels, 1), nn.Conv2d(channels, circles + 1, 1))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 1, h, w) to logits (n, 65, h/8, w/8) of the place and (n, circles + 1, h/8, w/8) of the identity."""
        features = self.trunk(self.stem(image))
        return self.detection(features), self.identity(features)


class Segmenter(nn.Module):
    """Ours: a U-Net at half the resolution; the disc's rim is smooth, and known to a fraction of a pixel all the same."""

    def __init__(self, channels: tuple[int, int, int] = (8, 24, 48)) -> None:
        super().__init__()
        first, second, third = channels
        self.level1 = DoubleConv(1, first)
        self.level2 = DoubleConv(first, second)
        self.level3 = nn.Sequential(*_convolution(second, third), *_convolution(third, third, dilation=2))
        self.up2 = DoubleConv(third + second, second)
        self.up1 = DoubleConv(second + first, first)
        self.out = nn.Conv2d(first, 1, 1)

    def forward(self, patch: Tensor) -> Tensor:
        """(n, 1, h, w) to logits of the same shape."""
        half = self.level1(avg_pool2d(patch, 2))
        quarter = self.level2(max_pool2d(half, 2))
        eighth = self.level3(max_pool2d(quarter, 2))
        quarter = self.up2(torch.cat([_doubled(eighth), quarter], 1))
        half = self.up1(torch.cat([_doubled(quarter), half], 1))
        return interpolate(self.out(half), scale_factor=2, mode="bilinear", align_corners=False)


class MassSegmenter(nn.Module):
    """Ours: a U-Net of five levels; what lies around and behind tells masses from lobules, so the last sees a whole B-scan."""

    def __init__(self, channels: tuple[int, ...] = (16, 32, 64, 128, 128)) -> None:
        super().__init__()
        self.down = nn.ModuleList(DoubleConv(*pair) for pair in pairwise((1, *channels)))
        wider = channels[::-1]
        self.up = nn.ModuleList(DoubleConv(low + high, high) for low, high in pairwise(wider))
        self.out = nn.Conv2d(channels[0], 1, 1)

    def forward(self, scan: Tensor) -> Tensor:
        """(n, 1, h, w) to logits of the same shape."""
        mean = scan.mean((2, 3), keepdim=True)  # scanners differ in gain and dynamic range
        spread = ((scan - mean) ** 2).mean((2, 3), keepdim=True).sqrt()
        levels = [self.down[0]((scan - mean) / (spread + 0.02))]
        for stage in self.down[1:]:
            levels.append(stage(max_pool2d(levels[-1], 2)))
        features = levels.pop()
        for stage in self.up:
            features = stage(torch.cat([_doubled(features), levels.pop()], 1))
        return self.out(features)


def weights_of(module: nn.Module) -> "OrderedDict[str, Tensor]":
    """Weights and statistics by name, detached, on the CPU, each its own memory."""
    return OrderedDict((name, value.detach().cpu().contiguous().clone()) for name, value in module.state_dict().items())


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1) -> list[nn.Module]:
    convolution = nn.Conv2d(inputs, outputs, size, stride, padding=dilation * (size // 2), dilation=dilation)
    return [convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


def _doubled(features: Tensor) -> Tensor:
    return interpolate(features, scale_factor=2, mode="bilinear", align_corners=True)
