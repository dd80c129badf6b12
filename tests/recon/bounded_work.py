"""Bounds of work that no clock measures: calls of functions are counted, so load and cores don't matter."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def calls(most: float) -> Iterator[None]:
    """End the work within, and fail, once it has called more functions than that, C's among them."""
    count = 0

    def counted(_frame, event, _argument):
        nonlocal count
        count += event in ("call", "c_call")
        if count > most:
            sys.setprofile(None)
            raise AssertionError(f"expected at most {most:.0f} calls")

    before = sys.getprofile()
    sys.setprofile(counted)
    try:
        yield
    finally:
        sys.setprofile(before)
