"""Files of others in every place that is written to: digests of all that is there, before a command and after it.

Each verb that writes, and each writer of the Python interface, finds its own earlier result with something of others in it, or
something else where its result is to be; whatever it does, nothing may be lost or changed but what it wrote there itself.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from campaign import full_disk, results, sources
from campaign.sources import Command
from recon.capture.manifest import MANIFEST
from recon.files import written_files
from recon.files.written_files import LIST

TEXT = "years of work\n"
DEMO = Command("demo", ("scene=sphere", "path=none", "poses=none", "film_frames=0", "tracing.samples=2", "board=boards"))
INTERFACE = "sonotwin.write_surface"
WRITERS = {INTERFACE: Command(INTERFACE, folders=("ball",))}  # of the Python interface


@dataclass(frozen=True)
class Case:
    """What came of a command where something of others was."""

    writer: str
    content: str
    status: int  # 0 or 1 done, 2 refused, -1 an error that isn't the user's
    said: str
    lost: tuple[str, ...]  # files that are gone or changed


Lay = Callable[[Path], object]  # puts something into `out`, or where it is to be


def write(path: Path, text: str = TEXT) -> None:
    """Write a file of others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _ours(out: Path) -> Path:
    """A file that the lists of a result name: the largest."""
    if out.is_file():
        return out
    named = [
        path.parent / name
        for path in sorted(out.rglob(LIST))
        for name in (written_files.read_list(path.parent) or {})
        if (path.parent / name).is_file()
    ]
    return max(named, key=lambda path: path.stat().st_size)


def _changed(out: Path) -> None:
    """Change a byte of one of our files."""
    path = _ours(out)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.unlink()
    path.write_bytes(content)


def _moved(out: Path) -> None:
    """Move one of our files to another disk, as it were, and link to it."""
    path = _ours(out)
    path.rename(out.parent / "moved")
    path.symlink_to(out.parent / "moved")


def _behind_a_link(out: Path) -> None:
    out.rename(out.parent / "disk")
    out.symlink_to("disk")
    write(out / "thesis.txt")


def _folder_of_ours(out: Path) -> Path:
    """The deepest folder of a result."""
    folders = [Path(place) for place, _, _ in os.walk(out)]
    return max(folders, key=lambda path: (len(path.parts), str(path)))


def _listless(out: Path) -> None:
    """A result of an earlier version."""
    for path in out.rglob(LIST):
        path.unlink()


IN_A_RESULT: dict[str, Lay] = {
    "a file": lambda out: write(out / "thesis.txt"),
    "a hidden file": lambda out: write(out / ".notes"),
    "a folder": lambda out: write(out / "thesis" / "chapters" / "1.txt"),
    "a file below, in a folder of ours": lambda out: write(_folder_of_ours(out) / "thesis.txt"),
    "a link to a file": lambda out: (write(out.parent / "thesis.txt"), (out / "link").symlink_to(out.parent / "thesis.txt")),
    "a link to a folder": lambda out: (write(out.parent / "thesis" / "1.txt"), (out / "link").symlink_to(out.parent / "thesis")),
    "one of ours, changed by hand": _changed,
    "one of ours, moved and linked": _moved,
    "a result behind a link, and a file": _behind_a_link,
    "a result of an earlier version": _listless,
}
INSTEAD: dict[str, Lay] = {
    "metrics.json and thesis.txt": lambda out: (write(out / "metrics.json", "{}\n"), write(out / "thesis.txt")),
    "a file in its place": write,
    "a folder of theses": lambda out: [write(out / f"{number}.txt") for number in range(3)],
}
SHARED = {("render", "a result of demo")}  # demo's report has the command that renders its capture anew
OF_A_FILE = ("one of ours, changed by hand", "one of ours, moved and linked", "a file in its place")  # where `out` is a file


def writers() -> list[Command]:
    """A command of each verb that writes, and the writers of the interface."""
    return [*full_disk.writers(), DEMO, *WRITERS.values()]


def run(place: Path, workers: int, only: Sequence[str] = (), kept: Path | None = None) -> list[Case]:
    """Attack each writer, those named or all; those in a file `kept` of cases, a line each, aren't attacked again."""
    chosen = [command for command in writers() if not only or command.verb in only]
    results = place.parent / "results"
    context = get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for _ in pool.map(_finish, [place] * len(chosen), [results] * len(chosen), chosen):
            pass
    cases = [] if kept is None or not kept.exists() else [_of_line(line) for line in kept.read_text().splitlines()]
    left = [command for command in chosen if command.verb not in {case.writer for case in cases}]
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        attacks = [pool.submit(_attack, place, results, command) for command in left]
        for attack in as_completed(attacks):
            found = attack.result()
            cases += found
            if kept is not None:
                with kept.open("a", encoding="utf-8") as file:
                    file.write("".join(json.dumps(asdict(case)) + "\n" for case in found))
            print(f"{found[0].writer}: {len(found)} cases, {sum(len(case.lost) for case in found)} files lost", flush=True)
    return sorted(cases, key=lambda case: [command.verb for command in chosen].index(case.writer))


def _of_line(line: str) -> Case:
    fields = json.loads(line)
    return Case(**fields | {"lost": tuple(fields["lost"])})


def _finish(place: Path, results: Path, command: Command) -> None:
    """Make one result of a writer, to be copied."""
    done = results / command.verb
    if done.exists():
        return
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        sources.lay_out(Path(name), place, command.folders)
        status, said = _do(command, command.line, Path(name))
        if status not in (0, 1):
            raise RuntimeError(f"{command.verb}: {said}")
        done.mkdir(parents=True)
        (Path(name) / command.out).rename(done / command.out)


def _attack(place: Path, results: Path, command: Command) -> list[Case]:
    """All contents for one writer, in this process."""
    own, cases = results / command.verb / command.out, []
    for content, lay in (IN_A_RESULT | INSTEAD).items():
        if own.is_file() and content not in OF_A_FILE:
            continue
        cases.append(_case(place, command, content, own if content in IN_A_RESULT else None, lay))
    if own.is_file():
        return cases
    for other in sorted(results.iterdir()):
        if other.name != command.verb and (found := next(other.iterdir())).is_dir():
            cases.append(_case(place, command, f"a result of {other.name}", found, None))
    raw = place / "ball" / "capture"
    cases.append(_case(place, command, "a capture with raw images", raw, _listless))
    return cases


def _case(place: Path, command: Command, content: str, copied: Path | None, lay: Lay | None) -> Case:
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        sources.lay_out(folder, place, command.folders)
        out = folder / command.out
        if copied is not None:
            shutil.copytree(copied, out, symlinks=True) if copied.is_dir() else shutil.copyfile(copied, out)
        own = content in IN_A_RESULT or (command.verb, content) in SHARED
        if lay is not None:
            lay(out)
        for beside in (f"{command.out}.notes", f".{command.out}.notes", f".{command.out}.old.txt"):
            write(folder / beside)
        before = digests(folder)
        kept = {path: digest for path, digest in before.items() if not (own and path in _replaceable(folder, out))}
        told = {path: (folder / path).read_bytes() for path in kept if path.endswith(f"/{MANIFEST}")}
        anew = full_disk.anew(command.verb) if own else ()
        status, said = _do(command, (*command.line, *anew), folder)
        after = digests(folder)
        changed = [path for path, digest in kept.items() if after.get(path) != digest]
        lost = tuple(path for path in changed if not (path in told and path in after and _takes_over(folder / path, told[path])))
    return Case(command.verb, content, status, said, lost)


def _takes_over(path: Path, old: bytes) -> bool:
    """Whether a capture's manifest has all that the old one said, the surface apart, of which a new take is the last."""
    try:
        now, before = json.loads(path.read_bytes()), json.loads(old)
        devices = now["devices"].items() >= before["devices"].items()
    except (ValueError, KeyError, AttributeError):
        return False
    same = all(now.get(name) == before[name] for name in before.keys() - {"devices", "surface"})
    return devices and same and before.keys() <= now.keys()


def _replaceable(folder: Path, out: Path) -> set[str]:
    """Files of an own result that its lists name, as they were written; of one that is a file, that itself."""
    found = {out.relative_to(folder).as_posix()} if out.is_file() and not out.is_symlink() and _is_ours(out) else set[str]()
    for path in out.resolve().rglob(LIST) if out.is_dir() else ():
        files = written_files.read_list(path.parent) or {}
        same = written_files.entries(path.parent) & files.keys()
        found |= {
            (path.parent / name).relative_to(folder.resolve()).as_posix()
            for name in same
            if written_files.is_unchanged(path.parent / name, files[name])
        }
    return found


def _is_ours(path: Path) -> bool:
    from recon.artwork import paper_sheet

    return path.suffix == ".pdf" and paper_sheet.is_sheet(path)


def digests(folder: Path) -> dict[str, str]:
    """Digests of all files in a folder, lists of sonotwin's apart, and targets of links; folders that are empty, too."""
    found = {}
    for place, folders, files in os.walk(folder):
        for name in (*files, *folders):
            path = Path(place, name)
            if path.is_symlink():
                found[path.relative_to(folder).as_posix()] = f"to {os.readlink(path)}"
            elif path.is_file() and name != LIST:
                found[path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _do(command: Command, line: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command in this process, where all is loaded already: status and what it said."""
    from sonotwin import cli

    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
            try:
                status = _write_surface() if command.verb == INTERFACE else cli.main(list(line))
            except Exception as error:  # noqa: BLE001 - whatever it is, it is counted
                return -1, repr(error)
    finally:
        os.chdir(before)
    return status, said.getvalue()


def _write_surface() -> int:
    """Call the interface's writer on a capture that was read."""
    import sys

    import sonotwin

    captured = sonotwin.read_surface(Path("ball/capture"))
    devices = {name: sonotwin.Device(size=captured.calibration.cameras[name].size) for name in ("cam1", "projector")}
    try:
        sonotwin.write_surface(Path("new"), {"cam1": captured.images}, captured.patterns, captured.calibration, devices)
    except sonotwin.InputError as error:
        print(f"sonotwin: {error}", file=sys.stderr)
        return 2
    return 0


def table(found: Sequence[Case]) -> list[str]:
    """Lines of Markdown: a row for all writers of equal counts."""
    lines = ["| writers | cases | done | refused by one line | lost or changed | errors |", "|---|---|---|---|---|---|"]
    writers = dict.fromkeys(one.writer for one in found)
    rows = [(writer, _counts([one for one in found if one.writer == writer])) for writer in writers]
    return [*lines, *results.alike([*rows, ("all", _counts(found))])]


def _counts(found: Sequence[Case]) -> str:
    done, refused, errors = (sum(one.status in some for one in found) for some in ((0, 1), (2,), (-1,)))
    return f"{len(found)} | {done} | {refused} | {sum(len(one.lost) for one in found)} | {errors}"
