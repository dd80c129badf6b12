"""Arguments of the public Python functions: of the right kind, shape and range, or refused in one line that names them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError, brief

Shape = Sequence[int | str]  # a letter stands for any length


def of_kind(name: str, value: object, *kinds: type, way: str = "") -> None:
    """Refuse an object of another kind.

    Parameters
    ----------
    name : str
        Of the argument, after that of its function: `decode: patterns`.
    way : str
        To the right one, for the message.
    """
    if isinstance(value, kinds) and not (isinstance(value, bool) and bool not in kinds):
        return
    expected = " or ".join("none" if kind is type(None) else kind.__name__ for kind in kinds)
    raise InputError(f"{name}: expected {expected}, found {described(value)}{way and '; '}{way}")


def described(value: object) -> str:
    """An object for messages: small ones as they are, arrays by their shape, others by their kind."""
    if value is None:
        return "none"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} of {value.dtype}"
    if isinstance(value, str | bytes | int | float | complex):
        return brief(value)
    kind = type(value).__name__
    return f"a {kind} of {len(value)}" if isinstance(value, list | tuple | dict | set) else f"a {kind}"


def numbers(name: str, value: Any, shape: Shape | None = None, finite: bool = True, what: str = "") -> NDArray:
    """An array of numbers of a shape, or of any, as it is; refused are other kinds, other shapes and, where they may not be, NaN.

    what : a noun for messages, such as `grey images`
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        array = np.empty(0, object)
    expected = (what or "numbers") + ("" if shape is None else f" of shape ({', '.join(map(str, shape))})")
    if array.dtype.kind not in "uif":
        raise InputError(f"{name}: expected {expected}, found {described(value)}")
    if shape is not None and (
        array.ndim != len(shape)
        or any(isinstance(length, int) and length != found for length, found in zip(shape, array.shape, strict=True))
    ):
        raise InputError(f"{name}: expected {expected}, found shape {array.shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite {expected}, found {np.count_nonzero(~np.isfinite(array))} that are not")
    return array


def grey_levels(name: str, value: Any, shape: Shape, bits: Any) -> NDArray:
    """Images of grey levels from 0 to `2**bits - 1`; floating-point ones may stand between the levels."""
    most = 2.0 ** whole(f"{name}: bits", bits, 1, 16) - 1
    count = f"{shape[0]} " if len(shape) == 3 and isinstance(shape[0], int) else ""
    images = numbers(name, value, shape, what=f"{count}grey images" if len(shape) == 3 else "a grey image")
    if images.size:
        low, high = float(images.min()), float(images.max())
        if low < 0 or high > most:
            raise InputError(f"{name}: expected grey levels from 0 to {most:.0f}, as of bits={bits}, found {low:g} to {high:g}")
        if images.dtype.kind == "f" and 0 < high <= 1 < most:
            raise InputError(f"{name}: expected grey levels from 0 to {most:.0f}, found {low:g} to {high:g}: shares of white?")
    if images.dtype == np.uint8 and bits > 8:
        raise InputError(f"{name}: expected 16-bit numbers, as of bits={bits}, found 8-bit ones: bits=8?")
    return images


def whole(name: str, value: Any, least: int, most: int) -> int:
    """A whole number within limits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise InputError(f"{name}: expected a whole number from {least} to {most}, found {described(value)}")
    return int(value)


def number(name: str, value: Any, least: float = 0.0, most: float = math.inf, above: bool = False) -> float:
    """A number within limits, not NaN.

    above : the least itself is refused, too
    """
    good = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not good or not least <= value <= most or (above and value == least):
        up_to = "" if most == math.inf else f" to {most:g}"
        raise InputError(f"{name}: expected a number {'above' if above else 'from'} {least:g}{up_to}, found {described(value)}")
    return float(value)


def image_size(name: str, value: Any, order: str = "width and height") -> tuple[int, int]:
    """Width and height of images, or height and width, as of the order that messages name."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise InputError(f"{name}: expected {order} in px, found {described(value)}")
    first, second = (whole(name, side, 1, 100_000) for side in value)
    return first, second


def places_of_pixels(name: str, value: Any) -> NDArray[np.float64]:
    """Matrices `world_from_pixel` : (n, 4, 4) of B-scans' pixels in space, mm; NaN where there is no pose."""
    matrices = np.asarray(numbers(name, value, ("n", 4, 4), finite=False), float)
    placed = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if len(placed) and np.abs(placed[:, 3] - [0, 0, 0, 1]).max() > 1e-6:
        last = placed[np.abs(placed[:, 3] - [0, 0, 0, 1]).max(axis=1).argmax(), 3]
        raise InputError(f"{name}: expected a last row of 0 0 0 1, found {' '.join(f'{x:g}' for x in last)}: transposed?")
    axes = np.linalg.norm(placed[:, :3, :2], axis=1)  # (n, 2) mm/px
    if len(placed) and not (axes > 0).all():
        raise InputError(f"{name}: expected axes of pixels in mm, found an axis of length 0")
    return matrices
