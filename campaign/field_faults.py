"""Nonsense on a command line: values that can't be meant, fields that don't exist, places that can't be written or read."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from campaign.text_faults import DIGITS
from sonotwin import config

OBJECT, LISTS = "{unknown: [1]}", "[[[[]]]]"
NONSENSE = {  # type of the field's value -> values that no field of the type can have
    bool: ("perhaps", "7", OBJECT, LISTS),
    int: ("nan", "inf", "many", OBJECT, LISTS, f"-{DIGITS}"),  # numbers without a point may be lengths, too
    float: ("nan", "inf", "-inf", "many", OBJECT, LISTS, "1e999"),
    str: (OBJECT, LISTS),
    list: ("many", OBJECT, "[nan,nan,nan]", LISTS),
    dict: ("many", LISTS),
    type(None): (OBJECT, LISTS),
}
FREE = {"over"}  # fields whose values are other fields and theirs
FOREIGN, FILE, LOOP = "foreign", "there.txt", "loop"
OUT = ("/dev/null", "/dev/null/below", "/proc/below", FILE, f"{FILE}/below", LOOP, "x" * 300)
TAKEN = ("", FOREIGN)  # of folders with files of others, which verbs that replace the whole folder refuse
BESIDE = (
    "render",
    "render-artefacts",
    "sweep",
    "film",
    "accuracy",
)  # verbs that write folders or files of their own into a folder
IN = ("", "nowhere", "/dev/zero", FILE, FOREIGN, LOOP, "x" * 300, "x" * 5000, "caf\udce9")


def overrides(verb: str, fields: Sequence[str], inputs: Sequence[str]) -> Iterator[str]:
    """Nonsense overrides of a verb.

    Parameters
    ----------
    fields : of a valid command
    inputs : names of those among them that are files or folders to be read
    """
    for way, value in _leaves(config.compose(verb, fields, config.fields_of(verb))):
        if way not in {"out", *inputs, *FREE}:
            yield from (f"{way}={nonsense}" for nonsense in NONSENSE.get(type(value), ()))
    yield from (
        "unknown=1",
        "rig.unknown=1",
        "rig=null",
        "=1",
        "out",
        "--out=x",
        "~unknown",
        "+unknown=1",
        "out=[a",
        "out={a: b}",
    )
    writes = any(field.startswith("out=") for field in fields)
    if writes:
        yield from (f"out={place}" for place in (*OUT, *(() if verb in BESIDE else TAKEN)))
    for name in inputs:
        yield from (f"{name}={place}" for place in IN)
        if writes:
            yield f"out={next(field.partition('=')[2] for field in fields if field.startswith(f'{name}='))}"  # what is read


def lay_out(folder: Path) -> None:
    """Make the places that are named above."""
    (folder / FOREIGN).mkdir()
    (folder / FOREIGN / "thesis.tex").write_text("years of work", encoding="utf-8")
    (folder / FILE).write_text("a text", encoding="utf-8")
    (folder / LOOP).symlink_to(LOOP)


def _leaves(tree: Any, way: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            yield from _leaves(value, f"{way}.{key}" if way else str(key))
    else:
        yield way, tree
