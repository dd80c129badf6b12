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
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba.core import caching
from platformdirs import user_cache_path

log = logging.getLogger(__name__)

OURS = ("recon", "scenes", "twin", "trainers", "sonotwin", "benchmarks")  # packages; others keep Numba's own cache
PARTS = 4  # of a range for each thread, so that who is done helps the other
UNUSED_DAYS = 30  # after which code compiled from other sources is deleted


def njit(function: Callable | None = None, noalias: bool = False, **options: Any) -> Any:
    """Compile a function on first use, as the decorator `numba.njit` does with the same options, and keep the result.

    With `noalias` no array that the function takes may share memory with another one that it writes to, as in loops over prange:
    then LLVM finds more vector instructions.
    """
    if function is None:
        return lambda decorated: njit(decorated, noalias, **options)
    dispatcher = numba.njit(cache=True, **options)(function)
    if noalias:
        dispatcher._compiler._customize_flags = _without_aliases
    _one_process_compiles(dispatcher)
    return dispatcher


def _without_aliases(flags: Any) -> Any:
    flags.noalias = True
    return flags


def in_threads(kernel: Callable[[int, int], Any], count: int) -> None:
    """Run `kernel(first, end)` over parts of range(count), in as many threads as Numba has.

    What takes its time must release the GIL: functions compiled with `nogil=True`, which is quick, whereas a loop over `prange`
    has all that is called within compiled thrice more, for each of the three functions that Numba makes of it.
    """
    threads = min(numba.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count)
        return
    parts = min(PARTS * threads, count)
    ends = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        deque(pool.map(kernel, ends[:-1], ends[1:]), maxlen=0)


def cache_folder() -> Path:
    """The folder of everything that was compiled."""
    place = os.environ.get("SONOTWIN_CACHE")
    return (Path(place) if place else user_cache_path("sonotwin", appauthor=False)) / "compiled"


def source_hash(module: Path, root: Path) -> str:
    """Hash of a module's source and of those that its compiled functions take names from, one by one through their imports.

    Parameters
    ----------
    module : the source file.
    root : the folder that holds the top-level packages.
    """
    digest = hashlib.sha256()
    for path in sorted(_sources(module, root)):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:20]


def _sources(module: Path, root: Path) -> set[Path]:
    found, waiting = set(), [module]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting.extend(_imported_for_kernels(path, root, path.stat().st_mtime_ns))
    return found


@cache
def _imported_for_kernels(path: Path, root: Path, _: int) -> tuple[Path, ...]:
    """Modules of ours from which a module takes names that its compiled functions, constants or types use."""
    tree = ast.parse(path.read_bytes())
    used = _names_for_kernels(tree)
    modules = [
        name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and not node.level
        for alias in node.names
        if (alias.asname or alias.name) in used
        for name in (f"{node.module}.{alias.name}", node.module)
    ]
    files = (root.joinpath(*name.split(".")).with_suffix(".py") for name in modules)
    return tuple(file for file in files if file.is_file() and file != Path(__file__))


def _names_for_kernels(tree: ast.Module) -> set[str]:
    """Names that a module's text uses, but for those of its plain functions that are never compiled."""
    plain = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef) and not node.decorator_list}
    others = [node for node in tree.body if not isinstance(node, ast.FunctionDef) or node.decorator_list]
    used = set(_names(others))
    waiting = [name for name in used if name in plain]  # as in `fast = njit(slow)`
    while waiting:
        more = set(_names([plain[waiting.pop()]])) - used
        used |= more
        waiting.extend(name for name in more if name in plain)
    return used


def _names(nodes: list[ast.stmt]) -> Iterator[str]:
    return (node.id for each in nodes for node in ast.walk(each) if isinstance(node, ast.Name))


class SourceHashLocator(caching._CacheLocator):
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
    home = cache_folder() / _module_name(path, root)
    folder = home / source_hash(path, root)
    try:
        if folder.is_dir():
            os.utime(folder)
        else:
            for old in home.glob("*/"):
                if time.time() - old.stat().st_mtime > UNUSED_DAYS * 86400:
                    shutil.rmtree(old, ignore_errors=True)
    except OSError:  # someone else's cache, or someone else just deleted it
        pass
    return folder


def _module_name(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts)


def _one_process_compiles(dispatcher: Any) -> None:
    """Lock the compilation of a function: a process that waited for another one loads its result."""
    compiler, cache = dispatcher._compiler, dispatcher._cache
    compile_now, save_now = compiler.compile, cache.save_overload

    def compile_once(args: tuple, return_type: Any) -> Any:
        place = Path(cache.cache_path)
        with FileLock(place / f"{dispatcher.__name__}.lock"):
            made = cache.load_overload(tuple(args), dispatcher.targetctx)
            if made is not None:
                dispatcher.targetctx.insert_user_function(made.entry_point, made.fndesc, [made.library])
                return made
            log.info("compiling %s.%s, once", dispatcher.__module__, dispatcher.__name__)
            made = compile_now(args, return_type)
            save_now(tuple(args), made)  # before another process may look
            return made

    compiler.compile = compile_once
    cache.save_overload = lambda *_: None  # saved already, and a loaded function cannot be saved


locators: list[Any] = caching.CacheImpl._locator_classes  # tried in this order
locators.insert(0, SourceHashLocator)
