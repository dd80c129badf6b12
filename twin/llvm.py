"""Finds an LLVM that DrJit works with, before DrJit is imported, and starts Mitsuba.

DrJit compiles its kernels with the LLVM library of the system. With LLVM 14, 15 or 16 DrJit 1.5 ends the whole process
("Cannot select: fminimum"), and where one of these is the only one, or comes first, DrJit takes it. So the library is chosen
here by its version, read from names and symbolic links without loading it; a version that nobody has tried is tried once in
a process of its own, and the verdict is remembered.

Every module of the twin gets Mitsuba from `load_mitsuba()`.
"""

import ctypes
import importlib.metadata
import json
import logging
import os
import platform
import re
import site
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from recon import interrupts
from recon.errors import InputError

PACKAGE = "libllvm19"  # of Debian and Ubuntu
VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")
WORKS = 19  # the version known to work; newer ones and 17, 18 are tried
OLDEST = 17  # what is older makes DrJit end the process, or isn't accepted by it
FOLDERS = (
    f"/usr/lib/{platform.machine()}-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/local/opt/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
)
PATTERNS = ("libLLVM.so*", "libLLVM-*.so*", "libLLVM*.dylib")
VERSION_IN_FILE = re.compile(r"^libLLVM(?:-|\.so\.|\.)(\d+)")
VERSION_IN_FOLDER = re.compile(r"llvm[-@](\d+)|/llvm/(\d+)\.")

# Compiles and runs a kernel with minimum and maximum, on which the unsuitable versions end the process.
KERNEL = """
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:  # Windows leaves no core files
    pass
import drjit
from drjit.llvm.ad import Float
x = drjit.arange(Float, 17)
print(drjit.sum(drjit.minimum(drjit.maximum(x - 3, 0), 5))[0], drjit.detail.llvm_version()[0])
"""
KERNEL_ANSWER = "55.0"
KERNEL_TIMEOUT = 120  # s
KILLED = 9  # number of the signal


@dataclass(frozen=True)
class Verdict:
    """Whether DrJit works with one LLVM library."""

    path: str
    version: int | None  # major version, None if no name tells it
    works: bool
    reason: str


def find_llvm() -> Path:
    """Find the LLVM library to use: `DRJIT_LIBLLVM_PATH` if that is set, else the best one of the system.

    Raises
    ------
    InputError
        If there is none that works; names what was found and what to do.
    """
    rejected = []
    for verdict in survey():
        if verdict.works:
            return Path(verdict.path)
        rejected.append(f"{verdict.path} ({verdict.reason})")
    found = f"found only {', '.join(rejected)}" if rejected else "found none"
    raise InputError(f"no LLVM that DrJit works with: {found}; {advice()}")


def advice() -> str:
    """Say how to get a working LLVM on this system."""
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        return f"unset DRJIT_LIBLLVM_PATH, or name an LLVM {WORKS} in it"
    if sys.platform == "darwin":
        return f"run 'brew install llvm@{WORKS}'"
    return f"run 'apt-get install {PACKAGE}' as root, with packages from https://apt.llvm.org where the system has none"


def survey() -> Iterator[Verdict]:
    """Judge the LLVM libraries in the order of preference, each when it is asked for; a given one is the only one."""
    explicit = os.environ.get("DRJIT_LIBLLVM_PATH")
    for path in [Path(explicit)] if explicit else candidates():
        yield judge(path)


def candidates() -> list[Path]:
    """List the LLVM libraries of the system, the same file once, best first: 19, then newer, then 18, 17, then the rest."""
    paths = [*_linker_cache(), *(path for folder in FOLDERS for path in _libraries(folder))]
    return sorted({path.resolve(): path.resolve() for path in paths if path.exists()}, key=_preference)


def judge(path: Path) -> Verdict:
    """Say whether DrJit works with a library: by its version if that is known, else by trying it in another process."""
    number = version(path)
    if not path.is_file():
        return Verdict(str(path), number, False, "no such file")
    if number == WORKS:
        return Verdict(str(path), number, True, f"LLVM {number} is known to work")
    if number is not None and number < OLDEST:
        return Verdict(str(path), number, False, f"DrJit can't work with LLVM {number}")
    return _remembered(path) or _try(path)


def version(path: Path) -> int | None:
    """Read the major version from the library's name, the name that it links to, or the folder; None if none holds it."""
    for name in (path.name, path.resolve().name):
        if match := VERSION_IN_FILE.match(name):
            return int(match[1])
    for folder in (path.parent, path.resolve().parent):
        if match := VERSION_IN_FOLDER.search(str(folder)):
            return int(match[1] or match[2])
    return None


def nvidia_gpus() -> int:
    """Count the NVIDIA GPUs that can trace rays: with a driver, CUDA and OptiX; asked of the driver itself, without DrJit."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
        ctypes.CDLL("libnvoptix.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if cuda.cuInit(0) != 0 or cuda.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value


def prepare() -> str:
    """Choose the Mitsuba variant and, for the processor, set `DRJIT_LIBLLVM_PATH`; to be called before DrJit is imported.

    Returns
    -------
    str
        `SONOTWIN_VARIANT` if set, else "cuda_ad_mono" where there is a usable NVIDIA GPU, else "llvm_ad_mono".

    Raises
    ------
    InputError
        If `SONOTWIN_VARIANT` is none of these two, or no LLVM works.
    """
    variant = os.environ.get("SONOTWIN_VARIANT") or ("cuda_ad_mono" if nvidia_gpus() else "llvm_ad_mono")
    if variant not in VARIANTS:
        raise InputError(f"SONOTWIN_VARIANT: expected one of {', '.join(VARIANTS)}, found {variant}")
    if variant == "llvm_ad_mono":
        os.environ["DRJIT_LIBLLVM_PATH"] = str(find_llvm())
    return variant


@cache
def load_mitsuba() -> ModuleType:
    """Import Mitsuba with a working LLVM or a GPU, and set its variant; the first call does the work.

    DrJit takes as many threads as there are cores, or `SONOTWIN_THREADS`, by which `twin.engine` shares them.

    Raises
    ------
    InputError
        As `prepare`.
    ModuleNotFoundError
        If the `twin` extra isn't installed.
    """
    importlib.metadata.version("mitsuba")  # a missing package is to be reported before a missing LLVM
    variant = prepare()
    with interrupts.held_back():  # an interrupt within these would be lost, or leave the extension half loaded
        import mitsuba

        mitsuba.set_variant(variant)
    if threads := os.environ.get("SONOTWIN_THREADS"):
        import drjit

        drjit.set_thread_count(int(threads))
    if not any((Path.home() / ".drjit").glob("*.bin")):
        logging.getLogger("recon.compiled").info("compiling %s.%s, once", "twin.optics", "kernels")
    return mitsuba


def cache_file() -> Path:
    """Name the file that remembers the verdicts, in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sonotwin" / "llvm.json"


def _preference(path: Path) -> tuple[int, int, str]:
    number = version(path)
    if number is None:
        return (3, 0, str(path))
    if number >= WORKS:
        return (0, number, str(path))
    return (1 if number >= OLDEST else 2, -number, str(path))


def _linker_cache() -> list[Path]:
    """LLVM libraries in the dynamic linker's cache, for a 64-bit processor."""
    ldconfig = next((path for path in ("/sbin/ldconfig", "/usr/sbin/ldconfig") if Path(path).exists()), None)
    if ldconfig is None or sys.platform != "linux":
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
    return [Path(path) for path in re.findall(r"^\s*libLLVM\S* \([^)]*64[^)]*\) => (\S+)$", listing, re.MULTILINE)]


def _libraries(folder: str) -> Iterator[Path]:
    """LLVM libraries in the folders that match an absolute pattern."""
    for pattern in PATTERNS:
        yield from Path("/").glob(f"{folder.removeprefix('/')}/{pattern}")


def _try(path: Path) -> Verdict:
    """Run a small kernel with the library in another process, and remember the outcome."""
    importlib.metadata.version("drjit")
    with tempfile.TemporaryDirectory() as home:  # an empty one, since DrJit keeps compiled kernels under HOME
        environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(path), "HOME": home, "PYTHONUSERBASE": site.getuserbase()}
        command = [sys.executable, "-c", KERNEL]
        try:
            done = subprocess.run(
                command, env=environment, cwd=home, capture_output=True, text=True, timeout=KERNEL_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            return Verdict(str(path), version(path), False, f"gave no answer within {KERNEL_TIMEOUT} s")
    answer = done.stdout.split()
    if done.returncode == 0 and answer[:1] == [KERNEL_ANSWER]:
        verdict = Verdict(str(path), int(answer[1]), True, f"LLVM {answer[1]} was tried and works")
    elif done.returncode < 0:
        verdict = Verdict(str(path), version(path), False, f"was tried and ended the process with signal {-done.returncode}")
    else:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        verdict = Verdict(str(path), version(path), False, f"was tried and failed: {last}")
    if done.returncode != -KILLED:  # someone else's doing, such as a lack of memory
        _remember(path, verdict)
    return verdict


def _remembered(path: Path) -> Verdict | None:
    try:
        return Verdict(**_read_cache()[_identity(path)])
    except (KeyError, TypeError):  # not tried yet, or remembered by another version
        return None


def _remember(path: Path, verdict: Verdict) -> None:
    content = _read_cache() | {_identity(path): asdict(verdict)}
    target = cache_file()
    with suppress(OSError):  # without a writable cache the library is tried again next time, which costs a second
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=target.parent, delete=False) as stream:
            json.dump(content, stream, indent=1)
        os.replace(stream.name, target)


def _read_cache() -> dict:
    try:
        content = json.loads(cache_file().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _identity(path: Path) -> str:
    return f"{path} {path.stat().st_mtime_ns} drjit {importlib.metadata.version('drjit')}"
