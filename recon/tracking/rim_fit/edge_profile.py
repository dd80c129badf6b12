"""The profile across an edge that a lens blurs and a motion smears, compiled."""

import math

from recon.compiled import njit

NARROW = 1.2  # standard deviations of the lens's blur: a box below that is as good as Gaussian


@njit(inline="always", error_model="numpy")
def _primitive(z, beyond):
    """Integral of the normal distribution function up to z; `beyond` is twice the function there."""
    return z * 0.5 * beyond + math.exp(-0.5 * z * z) * 0.3989422804014327


@njit(inline="always", error_model="numpy")
def blurred_step(distance, box, blur, wide):
    """The blurred step and its derivative by the distance, 1/px."""
    if abs(distance) > box / 2 + 4.5 * blur:
        return (1.0 if distance > 0 else 0.0), 0.0
    if box < NARROW * blur:
        scale = math.sqrt(wide)
        z = distance / scale
        return 0.5 * math.erfc(-z * 0.7071067811865476), math.exp(-0.5 * z * z) * 0.3989422804014327 / scale
    high, low = (distance + box / 2) / blur, (distance - box / 2) / blur
    to_high, to_low = math.erfc(-high * 0.7071067811865476), math.erfc(-low * 0.7071067811865476)
    share = (_primitive(high, to_high) - _primitive(low, to_low)) * blur / box
    return share, 0.5 * (to_high - to_low) / box
