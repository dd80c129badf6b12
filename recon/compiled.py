"""Compiled functions: Numba's `njit`, cached outside the tree by the hash of their sources.

Numba's own cache looks at the file of the calling function alone, so that an edited callee or constant of another module goes
unnoticed; and it lies beside the sources, so that a second clone compiles everything again. Here the key of a module's functions
is a hash of its source and of all sources of ours that its compiled functions take names from. A function is compiled by one
process at a time; others wait and load it.

The cache is the user's own, `~/.cache/sonotwin/compiled` on Linux; `SONOTWIN_CACHE` names another place. Deleting it is safe.
"""

import ast
import hashlib
import logging
import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

from recon import file_locks, user_cache

log = logging.getLogger(__name__)

NUMBA = "numba>=0.61,<0.69"  # whose undocumented parts are known to be as they are used here
OURS = ("recon", "scenes", "twin", "trainers", "sonotwin", "benchmarks")  # packages; others keep Numba's own cache
KERNEL: dict[str, Any] = {"noalias": True, "nogil": True, "_nrt": False, "error_model": "numpy"}  # options of kernels
Name = tuple[str, ...]  # one with dots, in parts


def njit(function: Callable | None = None, noalias: bool = False, **options: Any) -> Any:
    """Compile a function on first use, as the decorator `numba.njit` does with the same options, and keep the result.

    With `noalias` no array that the function takes may share memory with another one that it writes to:
    then LLVM finds more vector instructions.
    """
    if function is None:
        return lambda decorated: njit(decorated, noalias, **options)
    dispatcher = numba.njit(cache=True, **options)(function)
    if noalias:
        compiler = _of_numba(dispatcher, "_compiler")
        _of_numba(compiler, "_customize_flags")
        compiler._customize_flags = _without_aliases
    _one_process_compiles(dispatcher)
    return dispatcher


def _without_aliases(flags: Any) -> Any:
    flags.noalias = True
    return flags


def kernel(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop over arrays that may run beside others, as by `recon.threads.in_threads`, with options of `numba.njit`.

    It allocates no arrays, and none that it writes to shares memory with another one. So references to arrays need no counting,
    which takes a third to a half of the time to compile, and in inner loops as much of the time to run. The GIL is released, and
    a division by zero gives what it gives in NumPy.

    Functions that it calls are inlined, or kernels themselves: a plain one would take options from whoever compiles it first.
    """
    return njit(function, **KERNEL, **options)


def source_hash(module: Path, root: Path) -> str:
    """Hash of a module's source and of those that its compiled functions take names from, one by one through their imports.

    Parameters
    ----------
    module : the source file.
    root : the folder that holds the top-level packages.
    """
    digest = hashlib.sha256(repr(KERNEL).encode())
    for path in sorted(_sources(module, root)):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:20]


def _sources(module: Path, root: Path) -> set[Path]:
    found: dict[Path, frozenset[str]] = {}  # with the names that other modules take from each
    waiting = [(module, frozenset[str]())]
    while waiting:
        path, taken = waiting.pop()
        if path not in found or not taken <= found[path]:
            found[path] = taken | found.get(path, frozenset())
            waiting.extend(_imported_for_kernels(_parsed(path, path.stat().st_mtime_ns), root, found[path]))
    return set(found)


@dataclass(frozen=True, eq=False)
class _Text:
    """A module's imports and definitions, by name."""

    imported: dict[str, set[Name]]  # bound by an import anywhere, with the full names of what they may stand for
    plain: dict[str, set[Name]]  # functions that nothing decorates, with the imported names and such functions that each uses
    used: set[Name]  # of these, by all other text


@cache
def _imported_for_kernels(text: _Text, root: Path, taken: frozenset[str]) -> tuple[tuple[Path, frozenset[str]], ...]:
    """Modules of ours from which a module takes names that its compiled functions, constants or types use, and these names.

    taken : names that other modules take from it, be they its own or only imported there, as in a package's `__init__`.
    """
    places = (
        _place((*target, *use[1:]), root) for use in _used_for_kernels(text, taken) for target in text.imported.get(use[0], ())
    )
    # this file has no part in what is compiled but by the options of kernels: it says where the result lies
    return tuple((place, frozenset(names[:1])) for place, names in places if place is not None and place != Path(__file__))


@cache
def _parsed(path: Path, _: int) -> _Text:
    """The text of a module, of a time; parsed once for all processes, as that takes half of the time to import a kernel."""
    source = path.read_bytes()
    stamp = hashlib.sha256(Path(__file__).read_bytes() + b"\0" + source).digest()
    kept = user_cache.compiled_code() / "texts" / hashlib.sha256(str(path).encode(errors="surrogateescape")).hexdigest()[:20]
    with suppress(OSError):
        first, digest, content = _split(kept.read_bytes(), len(stamp))
        if first == stamp and digest == hashlib.sha256(content).digest():  # written by this very code, and whole
            user_cache.note_use(kept)
            return pickle.loads(content)
    text = _read(source)
    content = pickle.dumps(text)
    user_cache.keep(kept, stamp + hashlib.sha256(content).digest() + content)
    return text


def _split(content: bytes, length: int) -> tuple[bytes, bytes, bytes]:
    """The two digests, of a length each, that a file begins with, and the rest."""
    return content[:length], content[length : 2 * length], content[2 * length :]


def _read(source: bytes) -> _Text:
    tree = ast.parse(source)
    imported = _imported(tree)
    plain = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef) and not node.decorator_list}
    others = [node for node in tree.body if not isinstance(node, ast.FunctionDef) or node.decorator_list]

    def known(nodes: Iterable[ast.AST]) -> set[Name]:
        return {name for name in _names(nodes) if name[0] in imported or name[0] in plain}

    return _Text(imported, {name: known([node]) for name, node in plain.items()}, known(others))


def _imported(tree: ast.Module) -> dict[str, set[Name]]:
    """Names that are bound by imports anywhere in a module, with the full names of what they may stand for."""
    imported: dict[str, set[Name]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                full = tuple(alias.name.split("."))
                imported.setdefault(alias.asname or full[0], set()).add(full if alias.asname else full[:1])
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                imported.setdefault(alias.asname or alias.name, set()).add((*node.module.split("."), alias.name))
    return imported


@cache
def _place(full: Name, root: Path) -> tuple[Path | None, Name]:
    """The file of the module that a full name begins with, and the rest of the name; None if it isn't ours."""
    for length in range(len(full), 0, -1) if full[0] in OURS else ():
        stem = root.joinpath(*full[:length])
        for file in (stem.with_suffix(".py"), stem / "__init__.py"):
            if file.is_file():
                return file, full[length:]
    return None, full


def _used_for_kernels(text: _Text, taken: frozenset[str]) -> set[Name]:
    """Names that a module's text uses, but for those of its plain functions that are never compiled.

    taken : names that other modules use, so that plain functions among them may be compiled there.
    """
    used = {(name,) for name in taken} | text.used
    waiting = [name for name, *_ in used if name in text.plain]  # as in `fast = njit(slow)`
    while waiting:
        more = text.plain[waiting.pop()] - used
        used |= more
        waiting.extend(name for name, *_ in more if name in text.plain)
    return used


def _names(nodes: Iterable[ast.AST]) -> Iterator[Name]:
    """Names in a text, those with dots in one piece."""
    for node in nodes:
        parts, inner = [], node
        while isinstance(inner, ast.Attribute):
            parts.append(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name):
            yield (inner.id, *reversed(parts))
        else:
            yield from _names(ast.iter_child_nodes(node))


def _of_numba(place: Any, name: str) -> Any:
    """A part of Numba's that it doesn't document; ImportError for a version without it."""
    try:
        return getattr(place, name)
    except AttributeError:
        where = getattr(place, "__name__", type(place).__name__)
        found = f"numba {numba.__version__} without {where}.{name}"
        raise ImportError(f"expected {NUMBA}, whose cache of compiled code this extends, found {found}") from None


Locator: Any = _of_numba(caching, "_CacheLocator")


class SourceHashLocator(Locator):
    """Numba's cache locator for the modules beside this one: a folder for each hash of sources."""

    def __init__(self, folder: Path, line: int):
        self._folder, self._line = folder, line

    def get_cache_path(self) -> Any:
        """The folder, of these very sources."""
        return str(self._folder)

    def get_source_stamp(self) -> Any:
        """The sources' hash."""
        return self._folder.name

    def get_disambiguator(self) -> Any:
        """The line, for functions of the same name."""
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable, py_file: str) -> "SourceHashLocator | None":
        """For a function of our packages; None for any other, or where nothing can be written."""
        root, path = Path(__file__).resolve().parent.parent, Path(py_file).resolve()
        if py_func.__module__.partition(".")[0] not in OURS or not path.is_relative_to(root) or not path.is_file():
            return None
        locator = cls(_folder(path, root, path.stat().st_mtime_ns), py_func.__code__.co_firstlineno)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator


@cache
def _folder(path: Path, root: Path, _: int) -> Path:
    """The folder of a module's compiled functions; those of its former sources are deleted once they are long unused."""
    home = user_cache.compiled_code() / _module_name(path, root)
    folder = home / source_hash(path, root)
    try:
        if folder.is_dir():
            user_cache.note_use(folder)
        else:
            user_cache.remove_unused(home)
    except OSError:  # someone else's cache, or someone else just deleted it
        pass
    return folder


def _module_name(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts)


def _one_process_compiles(dispatcher: Any) -> None:
    """Lock the compilation of a function: a process that waited for another one loads its result."""
    compiler, cache = _of_numba(dispatcher, "_compiler"), _of_numba(dispatcher, "_cache")
    compile_now, save_now = _of_numba(compiler, "compile"), _of_numba(cache, "save_overload")

    def compile_once(args: tuple, return_type: Any) -> Any:
        place = Path(cache.cache_path)
        names = dispatcher.__module__, dispatcher.__name__
        with file_locks.held(
            place / f"{dispatcher.__name__}.lock", lambda _: log.info("waiting for another process that compiles %s.%s", *names)
        ):
            made = cache.load_overload(tuple(args), dispatcher.targetctx)
            if made is not None:
                dispatcher.targetctx.insert_user_function(made.entry_point, made.fndesc, [made.library])
                return made
            log.info("compiling %s.%s, once", *names)
            made = compile_now(args, return_type)
            save_now(tuple(args), made)  # before another process may look
            return made

    compiler.compile = compile_once
    cache.save_overload = lambda *_: None  # saved already, and a loaded function cannot be saved


locators: list[Any] = _of_numba(_of_numba(caching, "CacheImpl"), "_locator_classes")  # tried in this order
locators.insert(0, SourceHashLocator)
