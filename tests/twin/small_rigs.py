"""Devices of fewer pixels, for images that render in a moment."""

from recon.model.rig import CameraDevice, Rig


def half(rig: Rig) -> Rig:
    """A rig whose cameras have pixels of twice the size, a quarter as many."""
    devices = {name: shrunk(getattr(rig, name), 2) for name in ("cam1", "cam2")}
    sensors = {
        name: device.sensor.model_copy(update={"pixel_um": 2 * device.sensor.pixel_um}) for name, device in devices.items()
    }
    return rig.model_copy(update={name: device.model_copy(update={"sensor": sensors[name]}) for name, device in devices.items()})


def half_as_fields(rig: Rig) -> list[str]:
    """The same on a command line."""
    devices = {name: getattr(half(rig), name) for name in ("cam1", "cam2")}
    optics = [
        f"rig.{name}.optics.{field}={list(getattr(device.optics, field))}".replace(" ", "")
        for name, device in devices.items()
        for field in ("size", "focal_px", "centre_px")
    ]
    return optics + [f"rig.{name}.sensor.pixel_um={device.sensor.pixel_um}" for name, device in devices.items()]


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
