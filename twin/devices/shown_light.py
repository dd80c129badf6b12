"""Light of the images that a virtual projector is told to show. A sequence that is known ahead is traced in one pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError
from recon.model.patterns import Axis
from recon.model.rig import ProjectorDevice
from twin.optics.raster import Light

Pattern = NDArray[np.uint8]
Profile = tuple[Axis, bool, NDArray[np.float32]]


def profile_of(pattern: Pattern) -> Profile:
    """The profile of a pattern : (h, w) along the axis on which it varies; DeviceError if it varies along both.

    Black and white are the same by any gamma, so that all patterns may count as grey.
    """
    if (pattern == pattern[:1]).all():
        return "columns", False, np.float32(pattern[0]) / 255
    if (pattern == pattern[:, :1]).all():
        return "rows", False, np.float32(pattern[:, 0]) / 255
    raise DeviceError("projector: expected a pattern that varies along one axis, as the virtual one shows no others, found both")


@dataclass(frozen=True)
class KnownLight:
    """Patterns that will be shown, with their light all at once."""

    light: Light
    places: dict[bytes, int]  # by the pattern's profile: which of the light's
    projector: ProjectorDevice

    @classmethod
    def of(cls, patterns: Sequence[Pattern], projector: ProjectorDevice) -> "KnownLight":
        """Of patterns : (h, w) each."""
        profiles = [profile_of(pattern) for pattern in patterns]
        light = Light.of_profiles(projector.optics.size, profiles, projector)
        return cls(light, {_key(profile): k for k, profile in enumerate(profiles)}, projector)

    def find(self, pattern: Pattern) -> tuple[Light, int]:
        """The light that a pattern is part of, and its number therein; of an unknown one its own."""
        profile = profile_of(pattern)
        place = self.places.get(_key(profile))
        if place is not None:
            return self.light, place
        return Light.of_profiles(self.projector.optics.size, [profile], self.projector), 0


def _key(profile: Profile) -> bytes:
    axis, _, values = profile
    return axis.encode() + values.tobytes()
