"""Damage to files as the tests of readers do it, at random: bytes changed, cut out, put in or doubled."""

from hypothesis import strategies as st

TOKENS = [
    b"\0",
    b"\xff",
    b"-",
    b"1e999",
    b"9" * 5000,
    b".Nan",
    b"[",
    b"{",
    b'"',
    b"&a",
    b"*a",
    b"<",
    b"\n",
    b": ",
    b"../",
    b"-1",
    b"0",
]


@st.composite
def damaged(draw, whole: bytes, most: int = 4) -> bytes:
    """A file with up to `most` places damaged."""
    data = whole
    for _ in range(draw(st.integers(1, most))):
        start = draw(st.integers(0, len(data)))
        end = min(start + draw(st.integers(0, 30)), len(data))
        kind = draw(st.sampled_from(["change", "cut", "put", "double", "end"]))
        if kind == "change" and start < len(data):
            data = data[:start] + bytes([draw(st.integers(0, 255))]) + data[start + 1 :]
        elif kind == "cut":
            data = data[:start] + data[end:]
        elif kind == "put":
            data = data[:start] + draw(st.sampled_from(TOKENS)) + data[end if draw(st.booleans()) else start :]
        elif kind == "double":
            data = data[:end] + data[start:]
        elif kind == "end":
            data = data[:start]
    return data
