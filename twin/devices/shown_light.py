"""Light of the images that a virtual projector is told to show.

Patterns, which vary along one axis, are profiles; a sequence of them that is known ahead is traced in one pass. Others, such as
curves drawn on the skin, are images, each traced by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Axis
from recon.model.rig import ProjectorDevice
from twin.optics.projected_image import ImageLight
from twin.optics.raster import Light

Pattern = NDArray[np.uint8]
Profile = tuple[Axis, bool, NDArray[np.float32]]


def _profile_of(pattern: Pattern) -> Profile | None:
    """The profile of a pattern : (h, w) along the axis on which it varies; None if it varies along both.

    Black and white are the same by any gamma, so that all patterns may count as grey.
    """
    if (pattern == pattern[:1]).all():
        return "columns", False, np.float32(pattern[0]) / 255
    if (pattern == pattern[:, :1]).all():
        return "rows", False, np.float32(pattern[:, 0]) / 255
    return None


@dataclass(frozen=True)
class KnownLight:
    """Patterns that will be shown, with their light all at once."""

    light: Light
    places: dict[bytes, int]  # by the pattern's profile: which of the light's
    projector: ProjectorDevice

    @classmethod
    def of(cls, patterns: Sequence[Pattern], projector: ProjectorDevice) -> "KnownLight":
        """Of patterns : (h, w) each; those that vary along both axes can't be part of it."""
        profiles = [profile for pattern in patterns if (profile := _profile_of(pattern)) is not None]
        light = Light.of_profiles(projector.optics.size, profiles, projector)
        return cls(light, {_key(profile): k for k, profile in enumerate(profiles)}, projector)

    def find(self, pattern: Pattern) -> tuple[Light | ImageLight, int]:
        """The light that a pattern is part of, and its number therein; of an unknown one its own."""
        profile = _profile_of(pattern)
        if profile is None:
            return ImageLight.of(pattern, self.projector), 0
        place = self.places.get(_key(profile))
        if place is not None:
            return self.light, place
        return Light.of_profiles(self.projector.optics.size, [profile], self.projector), 0


def _key(profile: Profile) -> bytes:
    axis, _, values = profile
    return axis.encode() + values.tobytes()
