"""The Basler cameras that this computer sees."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FoundCamera:
    """A camera that answers."""

    serial: str
    model: str
    connection: str  # USB, GigE, Emulation
    label: str  # given by its user, or empty
    free: bool  # not in use by another program

    def __str__(self) -> str:
        label = f" ({self.label})" if self.label else ""
        return f"{self.serial}: {self.model}{label}, {self.connection}, {'free' if self.free else 'in use by another program'}"


def find_cameras() -> tuple[FoundCamera, ...]:
    """All Basler cameras at this computer, by serial number; takes about a second with Gigabit Ethernet."""
    from pypylon import pylon

    factory = pylon.TlFactory.GetInstance()
    found = [
        FoundCamera(
            info.GetSerialNumber(),
            info.GetModelName(),
            info.GetDeviceClass().removeprefix("Basler"),
            info.GetUserDefinedName(),
            factory.IsDeviceAccessible(info),
        )
        for info in factory.EnumerateDevices()
    ]
    return tuple(sorted(found, key=lambda camera: camera.serial))
