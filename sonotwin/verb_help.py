"""The text of `sonotwin VERB --help`: its docstring, fields with defaults, units and texts, and choices.

Fields are those of the verb's `Config`, which takes seconds to import with all that the verb calculates with. So the text is kept
beside the compiled code, by the state of all source files of this installation, and comes at once the next time.
"""

import ast
import hashlib
import itertools
import os
import re
import shlex
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from recon import user_cache
from recon.errors import InputError

PACKAGES = ("recon", "scenes", "twin", "trainers", "sonotwin", "conf")  # whose files a text may depend on
WIDTH = 100  # columns of a study's purpose
OF_ALL = "`sonotwin study --help` shows all fields of a study."
LIBRARIES = ("pydantic", "hydra-core", "omegaconf")  # whose versions it may depend on, too


def text(verb: str, module: str) -> str:
    """The help of a verb, which is in `module`; as it was kept, if no file has changed since.

    Raises
    ------
    InputError
        If the installation lacks the module.
    """
    root = hashlib.sha256(os.fsencode(Path(__file__).resolve().parent)).hexdigest()[:8]  # another clone's text is another file
    place, state = user_cache.help_texts() / f"{verb}.{root}.txt", _state()
    try:
        first, _, kept = place.read_text(encoding="utf-8").partition("\n")
        if first == state:
            user_cache.note_use(place)
            return kept
    except (OSError, ValueError):
        pass  # none yet
    made = make(verb, module)
    user_cache.keep(place, f"{state}\n{made}".encode())
    return made


def of_study(name: str) -> str:
    """The help of `sonotwin study name=...`: title and purpose of a study of conf/study or of a file, and its fields.

    Raises
    ------
    InputError
        If there is no such study.
    """
    from sonotwin import choices, study_plan

    study, path = study_plan.read_study(name), choices.file_of("study", name, "name")
    assert study is not None  # which a sweep alone is
    written = path.read_text(encoding="utf-8").splitlines()
    head = list(itertools.takewhile(lambda line: line.startswith("#"), written))
    purpose = re.sub(r"^\S+\.ya?ml: ", "", " ".join(line.removeprefix("#").strip() for line in head))
    usage = f"usage: sonotwin study name={shlex.quote(name)} out=FOLDER [field=value ...]"
    fields = "\n".join(f"  {line}".rstrip() for line in written[len(head) :])
    return "\n\n".join(filter(None, [usage, study.title, textwrap.fill(purpose, WIDTH), f"{path}:", fields, OF_ALL]))


def make(verb: str, module: str) -> str:
    """The help of a verb from its module; one without fields isn't imported."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        raise InputError(f"{verb}: this installation lacks {module}")
    source = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    parts = [f"usage: sonotwin {verb} [field=value ...]", ast.get_docstring(source) or ""]
    settings = next((node for node in source.body if isinstance(node, ast.ClassDef) and node.name == "Config"), None)
    if settings is not None and _has_no_fields(settings):
        return "\n\n".join(parts)
    from recon import interrupts
    from sonotwin import config

    with interrupts.held_back():  # while the verb is imported
        shown = config.shown(verb)
    parts.append("fields:\n\n" + "\n".join(f"  {line}".rstrip() for line in shown.splitlines()))
    choices = config.groups(verb)
    if choices:
        parts.append("choices:\n\n" + "\n".join(f"  {group}={'|'.join(names)}" for group, names in choices.items()))
    return "\n\n".join(parts)


def _has_no_fields(settings: ast.ClassDef) -> bool:
    """Whether settings have no fields of their own, and inherit none."""
    inherits = [ast.unparse(base) for base in settings.bases] != ["Part"]
    return not inherits and not any(isinstance(node, ast.AnnAssign) for node in settings.body)


def _state() -> str:
    """Digest of names, sizes and times of all files that a text may depend on; to read them would take as long as the imports."""
    root, found = Path(__file__).resolve().parent, hashlib.sha256()
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            found.update(f"{name} {version(name)}\n".encode())
    for package in PACKAGES:
        for folder in (root.parent / package, root / package):  # conf is beside the package in a clone, inside it in a wheel
            for line in sorted(_files(folder)):
                found.update(line.encode("utf-8", "surrogateescape"))
    return found.hexdigest()


def _files(folder: Path) -> Iterator[str]:
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return
    for entry in entries:
        if entry.name.startswith((".", "__pycache__")):
            continue
        with suppress(OSError):  # a link to nothing, or a file that was deleted meanwhile
            if entry.is_dir():
                yield from _files(Path(entry.path))
            elif entry.name.endswith((".py", ".yaml")):
                about = entry.stat()
                yield f"{entry.path} {about.st_size} {about.st_mtime_ns}\n"
