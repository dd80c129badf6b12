"""A folder of results for 3D Slicer: where it lies, and its tables. Needs neither Slicer nor sonotwin."""

import json
from typing import NamedTuple

MASSES, LEFT_OUT, SEARCH = "masses.mrk.json", "left_out.mrk.json", "search.txt"


class Row(NamedTuple):
    """A line of a table, and its place in the world, mm."""

    name: str
    told: str
    place: tuple


class Result(NamedTuple):
    """Tables of a folder of results."""

    search: str  # whether masses were looked for, and what came of it
    masses: list  # Row: the centre's and the volume's standard deviation are in `told`
    left_out: list  # Row: where a mass may be that isn't measured, and why


def find(chosen):
    """The folder for 3D Slicer in a chosen one: itself, or the only one below it.

    Raises
    ------
    ValueError
        If there is none, or more than one.
    """
    if not chosen.is_dir():
        raise ValueError(f"{chosen}: expected a folder of results, found none")
    if (chosen / "show.py").is_file():
        return chosen
    found = sorted(path.parent for path in chosen.glob("**/slicer/show.py"))
    if len(found) == 1:
        return found[0]
    if not found:
        raise ValueError(
            f"{chosen}: expected a result with a folder slicer, as `sonotwin reconstruct` or `fuse` writes it, found none"
        )
    names = ", ".join(str(path.relative_to(chosen)) for path in found)
    raise ValueError(f"{chosen}: expected one folder slicer, found {names}: choose one of these")


def read(folder):
    """Tables of a folder for 3D Slicer.

    Raises
    ------
    ValueError
        If a table is damaged.
    """
    masses, left_out = (_rows(folder / name) for name in (MASSES, LEFT_OUT))
    if (folder / SEARCH).is_file():
        search = (folder / SEARCH).read_text(encoding="utf-8").strip()
    else:  # of an older version
        search = "Whether masses were looked for isn't said in this folder."
    return Result(search, masses, left_out)


def _rows(path):
    if not path.is_file():
        return []
    try:
        (markups,) = json.loads(path.read_text(encoding="utf-8"))["markups"]
        if markups["coordinateSystem"] != "LPS":
            raise ValueError(f"{path}: expected coordinateSystem LPS, found {markups['coordinateSystem']}")
        return [Row(one["label"], one["description"], tuple(map(float, one["position"]))) for one in markups["controlPoints"]]
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: expected markups of 3D Slicer, found {type(error).__name__} ({error}): damaged?") from None
