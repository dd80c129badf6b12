"""Read a rig or a pattern sequence of `conf/` by its name, or one of the user's own from a YAML file."""

from pathlib import Path

from recon.capture import surface_part
from recon.errors import validated
from recon.files import yaml_text
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from sonotwin import config


def read_rig(source: str | Path = "meza2021") -> Rig:
    """Read the instruments of a rig.

    Parameters
    ----------
    source : str or Path
        A name from `conf/rig`, or the path of a YAML file with the same fields.

    Raises
    ------
    InputError
        If there is no such file, it is not YAML, or a field is wrong.
    """
    path = _file("rig", source)
    return validated(Rig, yaml_text.read(path), path)


def read_patterns(source: str | Path = "paper_surface") -> Patterns:
    """Read a pattern sequence, by a name from `conf/patterns` or by the path of a YAML file; raises as `read_rig` does."""
    return surface_part.read_patterns(_file("patterns", source))


def _file(group: str, source: str | Path) -> Path:
    """The file itself where there is one, else the choice of that name."""
    known = config.folder() / group / f"{source}.yaml"
    return known if known.is_file() and not Path(source).is_file() else Path(source)
