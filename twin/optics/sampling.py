"""Low-discrepancy sample points with mirrored pairs, so that samples shared by all patterns carry no common phase shift.

Within a pixel all N patterns share their samples; a mean offset of the samples from the pixel's centre is then a common shift
of the phase. Points come in pairs mirrored about the centre, which makes the mean offset exactly zero; the pairs are
Owen-scrambled Sobol' points (Burley 2020, hash-based Owen scrambling), a different scramble in each pixel and dimension.
"""

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi


def _hash_words(a: mi.UInt32, b: mi.UInt32) -> mi.UInt32:
    """A well-mixed 32-bit hash of two words (tiny encryption algorithm)."""
    return mi.sample_tea_32(a, b, 4)[0]


def _scramble(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Nested uniform (Owen) scrambling of a 32-bit fraction, by a Laine-Karras style hash of its reversed bits."""
    x = dr.brev(x) + seed
    for multiplier in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * mi.UInt32(multiplier)
    return dr.brev(x)


def sobol_pair(index: mi.UInt32, bits: int, seed: mi.UInt32) -> mi.Point2f:
    """Point `index` of a scrambled, shuffled 2-D Sobol' set of 2**bits points : values in [0, 1)."""
    index = _scramble(index, seed) & mi.UInt32((1 << bits) - 1)
    x = dr.brev(index)
    y, direction = mi.UInt32(0), 1 << 31
    for bit in range(bits):
        y ^= dr.select((index >> bit) & 1 == 1, mi.UInt32(direction), mi.UInt32(0))
        direction ^= direction >> 1
    x = _scramble(x, _hash_words(seed, mi.UInt32(1)))
    y = _scramble(y, _hash_words(seed, mi.UInt32(2)))
    return mi.Point2f(mi.Float(x >> 8), mi.Float(y >> 8)) * 2**-24


class PairedPoints:
    """Sample `index` of a power of two in each pixel: independent 2-D dimensions.

    Mirrored ones repeat the point of sample 2j with the opposite sign in sample 2j+1.

    Parameters
    ----------
    pixel : UInt32
        Index of the pixel, the key of its scrambles.
    index : UInt32
        Sample number, 0 to samples-1.
    samples : int
        Samples a pixel, a power of two, at least 2.
    seed : UInt32
    """

    def __init__(self, pixel: mi.UInt32, index: mi.UInt32, samples: int, seed: mi.UInt32) -> None:
        self._key = _hash_words(pixel, seed)
        self._index = index
        self._bits = samples.bit_length() - 1
        self._dimension = 0

    def split(self, count: int) -> Iterator["PairedPoints"]:
        """`count` points, a power of two, for this sample; those of all samples make one larger set, independent of this one."""
        for k in range(count):
            yield PairedPoints(self._key, self._index * count + k, count << self._bits, mi.UInt32(0))

    def _next_seed(self) -> mi.UInt32:
        self._dimension += 1
        return _hash_words(self._key, mi.UInt32(self._dimension))

    def square(self) -> mi.Point2f:
        """The next point in the unit square, not mirrored."""
        return sobol_pair(self._index, self._bits, self._next_seed())

    def mirrored_square(self) -> mi.Point2f:
        """The next point in [-1/2, 1/2]^2, in mirrored pairs."""
        return self._mirrored(self._next_of_pair() - 0.5)

    def mirrored_disc(self) -> mi.Point2f:
        """The next point in the unit disc, in mirrored pairs."""
        return self._mirrored(mi.warp.square_to_uniform_disk_concentric(self._next_of_pair()))

    def mirrored_normal(self) -> mi.Point2f:
        """The next two standard normal values, in mirrored pairs."""
        return self._mirrored(mi.warp.square_to_std_normal(self._next_of_pair()))

    def _next_of_pair(self) -> mi.Point2f:
        return sobol_pair(self._index >> 1, self._bits - 1, self._next_seed())

    def _mirrored(self, point: mi.Point2f) -> mi.Point2f:
        return dr.select(self._index & 1 == 1, -point, point)
