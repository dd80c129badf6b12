"""Devices of fewer pixels, for images that render in a moment."""

from recon.model.rig import CameraDevice


def shrunk(device: CameraDevice, times: int) -> CameraDevice:
    """A camera with fewer, larger pixels, of the same view."""
    optics = device.optics.model_copy(update={
        "size": tuple(length // times for length in device.optics.size),
        "focal_px": tuple(f / times for f in device.optics.focal_px),
        "centre_px": tuple((c - (times - 1) / 2) / times for c in device.optics.centre_px),
    })  # fmt: skip
    return device.model_copy(update={"optics": optics})


def cropped(device: CameraDevice, size: tuple[int, int], first: tuple[int, int] | None = None) -> CameraDevice:
    """A camera that reads out a part of its sensor, from a pixel on, else its middle: the same pixels, of a narrower view."""
    whole, (u, v) = device.optics.size, device.optics.centre_px
    start = first or ((whole[0] - size[0]) // 2, (whole[1] - size[1]) // 2)
    optics = device.optics.model_copy(update={"size": size, "centre_px": (u - start[0], v - start[1])})
    return device.model_copy(update={"optics": optics})
