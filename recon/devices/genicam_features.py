"""Features of a GenICam camera, set and read by name: a refusal becomes one line with the feature and its range."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from recon.devices.interfaces import DeviceError
from recon.errors import short

Value = bool | int | float | str


@dataclass(frozen=True)
class Features:
    """Features of one open camera.

    Models name some of them differently, the older ones of Gigabit Ethernet above all: methods take all names of a feature and
    use the first that the camera has. They raise DeviceError if it has none, or is gone.
    """

    camera: str  # its name in messages
    device: Any  # pypylon.pylon.InstantCamera

    def available(self, *names: str) -> str | None:
        """First of some names by which a feature can be read or set now, or None."""
        with said_by(self.camera):
            nodes = self.device.GetNodeMap()
            return next((name for name in names if _usable(nodes.GetNode(name))), None)

    def put(self, value: Value, *names: str) -> None:
        """Set a feature; DeviceError with its range or choices if the camera refuses the value."""
        from pypylon import genicam

        name, node = self._found(names)
        try:
            node.SetValue(value)
        except (genicam.GenericException, TypeError) as error:
            raise DeviceError(f"{self.camera}: {name}: expected {_range_of(node) or words(error)}, found {value}") from None

    def get(self, *names: str) -> Any:
        """Value of a feature."""
        _, node = self._found(names)
        with said_by(self.camera):
            return node.GetValue()

    def choices(self, name: str) -> tuple[str, ...]:
        """Values that a feature can be set to now; none if the camera hasn't that feature."""
        if self.available(name) is None:
            return ()
        return tuple(self._found((name,))[1].GetSettableValues())

    def execute(self, *names: str) -> None:
        """Give a command."""
        _, node = self._found(names)
        with said_by(self.camera):
            node.Execute()

    def _found(self, names: tuple[str, ...]) -> tuple[str, Any]:
        name = self.available(*names)
        if name is None:
            wanted = " or ".join(names)
            raise DeviceError(f"{self.camera}: {wanted}: expected a feature of this camera, found none that can be used now")
        return name, self.device.GetNodeMap().GetNode(name)


@contextmanager
def said_by(camera: str) -> Iterator[None]:
    """Turn pylon's exceptions into DeviceError, with the camera's name and pylon's words."""
    from pypylon import genicam

    try:
        yield
    except genicam.GenericException as error:
        raise DeviceError(f"{camera}: {words(error)}") from None


def words(error: Exception) -> str:
    """What an exception of pylon says, without the place in pylon's sources."""
    return short(str(error).partition(" : ")[0], 200)


def _usable(node: Any) -> bool:
    return node.IsReadable() or node.IsWritable()


def _range_of(node: Any) -> str | None:
    """Words for the values that a feature takes; None where it gives neither a range nor choices."""
    if hasattr(node, "GetSettableValues"):
        return " or ".join(node.GetSettableValues())
    if hasattr(node, "GetMin"):
        return f"{node.GetMin():g} to {node.GetMax():g} {node.GetUnit()}".rstrip()
    return None
