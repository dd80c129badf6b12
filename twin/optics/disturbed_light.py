"""Light whose frames have errors: a sequence as a lamp that flickers shows it, and light from elsewhere."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Fringes, Patterns
from recon.model.rig import CameraDevice, ProjectorDevice
from twin.conditions import Array, FrameDraw
from twin.optics.light_transport import Images
from twin.optics.raster import Light
from twin.sensor import Exposure, Stack, electrons_per_radiance, number_per_electron


def emitted(patterns: Patterns, projector: ProjectorDevice, errors: FrameDraw) -> Light:
    """A sequence as the projector shows it, each frame with its own brightness and its own shift."""
    profiles = patterns.profiles()
    for part, place in patterns.slices():
        if isinstance(part, Fringes) and part.waveform == "sine":
            length = patterns.length(part.axis)
            for k, late in enumerate(errors.shift[place]):
                moved = part.model_copy(update={"origin": part.zero(length) - late * part.pitch / part.steps})
                profiles[place.start + k] = (part.axis, False, moved.profiles(length)[k])
    light = Light.of_profiles(patterns.projector_size, profiles, projector)
    return replace(light, profiles=tuple(np.float32(gain) * one for gain, one in zip(errors.gain, light.profiles, strict=True)))


@dataclass(frozen=True)
class _Lit:
    """Images : n of (h, w), W/mm^2/sr, each with an even light of its own added."""

    images: Stack
    added: NDArray[np.float32]  # (n,)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all images together : (n, h, w)."""
        return self.images.shape

    def __getitem__(self, k: int) -> Images:
        return self.images[k] + self.added[k]


def with_stray(images: Stack, stray_dn: Array, device: CameraDevice, wavelength_nm: float, exposure: Exposure) -> Stack:
    """Images : n of (h, w), W/mm^2/sr, each with its stray light : (n,) 8-bit DN."""
    electrons = stray_dn * 2 ** (exposure.bits - 8) / number_per_electron(device.sensor, exposure)
    radiance = electrons / (electrons_per_radiance(device, wavelength_nm) * exposure.time_s)
    return _Lit(images, radiance.astype(np.float32)) if radiance.any() else images
