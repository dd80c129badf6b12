"""Read a rig or a pattern sequence of `conf/` by its name, or one of the user's own from a YAML file."""

from pathlib import Path
from typing import Any

from recon.errors import InputError, did_you_mean, short, validated
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from sonotwin import config


def read_rig(source: str | Path = "meza2021") -> Rig:
    """Read the instruments of a rig.

    Parameters
    ----------
    source : str or Path
        A name from `conf/rig`, or the path of a YAML file with the same fields, or that starts from one: `defaults: [meza2021]`.

    Raises
    ------
    InputError
        If there is no such file, it is not YAML, or a field is wrong.
    """
    return validated(Rig, read("rig", source), file_of("rig", source))


def read_patterns(source: str | Path = "paper_surface") -> Patterns:
    """Read a pattern sequence, by a name from `conf/patterns` or by the path of a YAML file; raises as `read_rig` does."""
    return validated(Patterns, read("patterns", source), file_of("patterns", source))


def read(group: str, source: str | Path, field: str = "") -> dict[str, Any]:
    """Content of a choice, by its name in the group or by the path of a YAML file; raises as `read_rig` does."""
    return config.read_choice(group, file_of(group, source, field))


def file_of(group: str, source: str | Path, field: str = "") -> Path:
    """The file itself where there is one, else the choice of that name; InputError if there is neither, with the field's name."""
    known, given = config.folder() / group / f"{source}.yaml", Path(source)
    if given.is_file() or len(given.parts) != 1 or given.suffix:
        return given
    if not known.is_file():
        names = sorted(choice.stem for choice in known.parent.glob("*.yaml"))
        expected = f"{field or group}: expected one of {', '.join(names)}, or a YAML file"
        raise InputError(f"{expected}, found {short(str(source))}{did_you_mean(str(source), names)}")
    return known
