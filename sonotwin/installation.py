"""Looks at the installation: Python, machine, packages, LLVM, GPU, caches. Imports nothing that could end the process."""

import importlib.metadata
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from recon import cores
from sonotwin import namesakes
from twin import llvm

OLDEST_PYTHON = (3, 11)
REINSTALL = "pip install --force-reinstall --no-deps with the wheel, or with '.' in a clone"
EXTRAS = ("twin", "study", "live", "train", "dev", "docs")
MODULES = {  # where a package isn't imported by the name that it is installed by
    "hydra-core": "hydra",
    "import-linter": "importlinter",
    "lightning-fabric": "lightning_fabric",
    "myst-parser": "myst_parser",
    "opencv-contrib-python-headless": "cv2",
    "pynrrd": "nrrd",
    "simpleitk": "SimpleITK",
    "pytest-xdist": "xdist",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "scikit-fem": "skfem",
    "scikit-image": "skimage",
}
BROUGHT_BY = {
    "pydantic_core": "pydantic",
    "drjit": "mitsuba",
    "omegaconf": "hydra",
    "websockets": "viser",
}  # imported by us, required by what we require


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    part: str  # core, twin, live, train, dev, docs: who needs it; or machine
    what: str
    state: Literal["ok", "absent", "unused", "problem"]  # absent: not there, and the core does without
    found: str
    remedy: str = ""


def examine() -> list[Finding]:
    """Look at everything; takes some seconds, most of them for importing the packages in another process."""
    return [*_system(), *_own_packages(), *_packages(), *_llvm(), *_gpu(), *_cameras(), *_folders()]


def extra_of(module: str) -> str | None:
    """Name the part, "core" or an extra, that a missing module belongs to; None if it is none of sonotwin's requirements."""
    top = module.partition(".")[0]
    top = BROUGHT_BY.get(top, top)
    return next((part for part, name, _ in requirements() if MODULES.get(name, name) == top), None)


def how_to_install(part: str) -> str:
    """The command that brings what a part of an installation lacks, of a wheel and of a clone alike.

    pip takes the parts of what is installed from its metadata: it needs neither the wheel nor an index that has sonotwin.
    """
    return f"pip install '{'sonotwin' if part == 'core' else f'sonotwin[{part}]'}'"


def requirements() -> Iterator[tuple[str, str, str]]:
    """Yield sonotwin's own requirements: part ("core" or the extra), package, version range."""
    from packaging.requirements import Requirement

    for line in importlib.metadata.requires("sonotwin") or []:
        requirement = Requirement(line)
        marker = requirement.marker
        if marker is None or marker.evaluate({"extra": ""}):
            yield "core", requirement.name, str(requirement.specifier)
            continue
        for extra in EXTRAS:
            if marker.evaluate({"extra": extra}):
                yield extra, requirement.name, str(requirement.specifier)


def _system() -> Iterator[Finding]:
    text = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info >= OLDEST_PYTHON:
        yield Finding("core", "Python", "ok", text)
    else:
        yield Finding("core", "Python", "problem", text, "install Python 3.11 or newer")
    yield Finding("machine", "system", "ok", _system_name())
    text = f"{cores.usable()} cores"
    if hasattr(os, "sysconf"):  # not on Windows
        text += f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB of memory"
    yield Finding("machine", "size", "ok", text)


def _system_name() -> str:
    if hasattr(platform, "freedesktop_os_release") and Path("/etc/os-release").exists():
        return f"{platform.freedesktop_os_release().get('PRETTY_NAME', 'Linux')}, {platform.machine()}"
    return f"{platform.platform()}, {platform.machine()}"


def _own_packages() -> Iterator[Finding]:
    """Check that `recon`, `twin` ... are ours: found beside `sonotwin`, without another distribution's files among them."""
    brought = importlib.metadata.packages_distributions()
    sound: dict[Path, list[str]] = {}
    for place in namesakes.places():
        strangers = sorted(set(brought.get(place.name, ())) - {"sonotwin"})
        if place.found is None:
            yield Finding("core", place.name, "problem", "not found", REINSTALL)
        elif place.hidden:
            yield Finding("core", place.name, "problem", f"{place.found} hides ours, {place.ours}", place.remedy)
        elif strangers and place.found.parent.name == "site-packages":
            remedy = f"pip uninstall {' '.join(strangers)}, then {REINSTALL}"
            found = f"{place.found} has files of {', '.join(strangers)}, too"
            yield Finding("core", place.name, "problem", found, remedy)
        else:
            sound.setdefault(place.found.parent, []).append(place.name)
    for folder, names in sound.items():
        yield Finding("core", "sonotwin", "ok", f"{', '.join(names)} in {folder}")


def _packages() -> Iterator[Finding]:
    """One finding for what is sound of a part's packages, one for what is absent of an extra, and one for each fault."""
    from packaging.specifiers import SpecifierSet

    wanted = list(requirements())
    installed = {name: _version(name) for _, name, _ in wanted}
    broken = _failing_imports([MODULES.get(name, name) for _, name, _ in wanted if installed[name] is not None])
    sound: dict[str, list[str]] = {}
    absent: dict[str, list[str]] = {}
    faults = []
    for part, name, accepted in wanted:
        remedy = how_to_install(part)
        found = installed[name]
        failure = broken.get(MODULES.get(name, name))
        if found is None and part != "core":
            absent.setdefault(part, []).append(name)
        elif found is None:
            faults.append(Finding(part, name, "problem", "not installed", remedy))
        elif not SpecifierSet(accepted).contains(found, prereleases=True):
            faults.append(Finding(part, name, "problem", f"{found}, expected {accepted}", remedy))
        elif failure is not None:
            again = f"pip install --force-reinstall {name}"
            faults.append(Finding(part, name, "problem", f"{found}, can't be imported: {failure}", again))
        else:
            sound.setdefault(part, []).append(f"{name} {found}")
    yield from (Finding(part, "packages", "ok", ", ".join(names)) for part, names in sound.items())
    for part, names in absent.items():
        yield Finding(part, "packages", "absent", f"{', '.join(names)}; {how_to_install(part)}")
    yield from faults


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _failing_imports(modules: list[str]) -> dict[str, str]:
    """Import modules in one other process, which may crash; returns the reason for each that fails."""
    program = """
import importlib, sys
for name in sys.argv[1:]:
    print("trying", name, flush=True)
    try:
        importlib.import_module(name)
    except (ImportError, OSError) as error:
        print("failed", name, " ".join(str(error).split()), flush=True)
print("done")
"""
    done = subprocess.run([sys.executable, "-c", program, *modules], capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    failures = {line.split()[1]: line.split(maxsplit=2)[-1] for line in lines if line.startswith("failed ")}
    if lines and lines[-1].startswith("trying "):
        crashed = lines[-1].split()[1]
        failures[crashed] = f"the process ended with status {done.returncode}"
        failures |= _failing_imports(modules[modules.index(crashed) + 1 :])
    return failures


def _llvm() -> Iterator[Finding]:
    if _version("drjit") is None:
        yield Finding("twin", "LLVM", "absent", "not looked for: DrJit is not installed")
        return
    chosen = False
    for verdict in llvm.survey():
        if not verdict.works:
            yield Finding("twin", "LLVM", "unused", f"{verdict.path} rejected: {verdict.reason}")
        elif not chosen:
            chosen = True
            yield Finding("twin", "LLVM", "ok", f"{verdict.path} chosen: {verdict.reason}")
    if not chosen:
        yield Finding("twin", "LLVM", "problem", "none that DrJit works with", llvm.advice())


def _gpu() -> Iterator[Finding]:
    count = llvm.nvidia_gpus()
    variant = os.environ.get("SONOTWIN_VARIANT") or ("cuda_ad_mono" if count else "llvm_ad_mono")
    gpus = f"{count} NVIDIA GPU{'s' if count > 1 else ''}" if count else "no NVIDIA GPU with driver and OptiX, not needed"
    yield Finding("twin", "GPU", "ok" if count else "absent", gpus)
    if variant in llvm.VARIANTS:
        yield Finding("twin", "variant", "ok", variant)
    else:
        remedy = f"unset SONOTWIN_VARIANT, or set it to {' or '.join(llvm.VARIANTS)}"
        yield Finding("twin", "variant", "problem", f"SONOTWIN_VARIANT={variant}", remedy)


def _cameras() -> Iterator[Finding]:
    """Look for Basler cameras in another process: drivers of cameras may crash, and emulate some where an environment says so."""
    if _version("pypylon") is None:
        return
    program = "from recon.devices import basler_listing\nfor camera in basler_listing.find_cameras(): print(camera)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    if done.returncode:
        yield Finding("live", "Basler cameras", "problem", f"the search ended with status {done.returncode}", "reinstall pypylon")
    elif not done.stdout:
        yield Finding("live", "Basler cameras", "absent", "none found at this computer")
    for line in done.stdout.splitlines():
        yield Finding("live", "Basler camera", "ok", line)


def _folders() -> Iterator[Finding]:
    slower = "make it writable, or set HOME: programs start slower without"
    places = [
        ("cache", llvm.cache_file().parent, slower),
        ("kernel cache", Path.home() / ".drjit", slower),
        ("working folder", Path.cwd(), "choose another one"),
        ("temporary folder", Path(tempfile.gettempdir()), "choose another one"),
    ]
    if _version("platformdirs") is not None:
        from recon import user_cache

        remedy = f"make it writable, or name another one in {user_cache.VARIABLE}: programs compile anew each time without"
        places.insert(1, ("compiled code", user_cache.compiled_code(), remedy))
    for what, place, remedy in places:
        existing = next(path for path in (place, *place.parents) if path.exists())
        if os.access(existing, os.W_OK):
            yield Finding("machine", what, "ok", f"{place} can be written")
        else:
            yield Finding("machine", what, "problem", f"{place} can't be written", remedy)
