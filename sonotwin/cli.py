"""The command `sonotwin VERB [field=value ...]`: the table of verbs, their help, and what a mistake looks like.

Verbs are imported when they are called, so that `sonotwin --help` is instant and a verb needs only the packages that it uses.
Exit status: 0 done, 2 a mistake of the user or of the installation (one line on stderr), 130 interrupted by Ctrl-C, 143 ended by
SIGTERM, which schedulers send, or 129 by SIGHUP, which a closed terminal sends; all of these clean up first.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from io import TextIOWrapper

from recon.errors import InputError

BROKEN_PIPE = 13  # number of the signal, which Windows doesn't have


@dataclass(frozen=True)
class Verb:
    """A verb of the command line."""

    name: str
    summary: str  # one line, for `sonotwin --help`

    @property
    def module(self) -> str:
        """The module with the verb's docstring, `Config` and `run`."""
        return f"sonotwin.verbs.{self.name.replace('-', '_')}"


VERBS = (  # in the order in which a person meets them
    Verb("doctor", "check this installation and say what to do about each problem"),
    Verb("demo", "render a phantom, reconstruct its surface, compare with the truth"),
    Verb("render", "render a capture of a scene with its ground truth"),
    Verb("render-artefacts", "render the artefacts of an acceptance test in the prescribed places"),
    Verb("sweep", "render a freehand ultrasound sweep of a scene with its ground truth"),
    Verb("render-benchmark", "render a round of the open benchmark: sessions, and apart from them their truth"),
    Verb("score-benchmark", "score anybody's results of the open benchmark against the truth"),
    Verb("dataset", "render tracking frames with ground truth, as training data"),
    Verb("film", "render a film of the moving target with its ground truth"),
    Verb("print", "draw a calibration board or the probe's target for a printer, true to scale"),
    Verb("patterns", "write the patterns as images for a projector, with a timing sheet"),
    Verb("record", "record a board, a surface or a sweep from cameras, projector and scanner, or virtual ones"),
    Verb("describe", "write the manifest of images recorded elsewhere, of a board or a surface"),
    Verb("calibrate-optics", "calibrate cameras and projector from images of a board, rendered or real"),
    Verb("identify", "measure the rig's parameters from its own captures, for a twin of that rig"),
    Verb("calibrate-target", "measure the probe's target as it was printed, from any film of it"),
    Verb("calibrate-tip", "find a tracked tool's tip, from a film of it pivoting in a dimple"),
    Verb("calibrate-probe", "calibrate the ultrasound probe from B-scans of a phantom"),
    Verb("compare-tip", "compare a needle's tip in B-scans with the tracked one: tracker, tip and probe together"),
    Verb("measure-lag", "measure the lag of the scanner's images behind the tracked poses"),
    Verb("check", "check whether the rig is still as it was calibrated, before a session"),
    Verb("certify", "certify a rig by calibrated spheres, a ball bar and a plane: errors, uncertainties, decisions"),
    Verb("correct-optics", "correct a calibration for drift since, by a session's own images"),
    Verb("surface", "reconstruct the surface from a capture, rendered or real"),
    Verb("track", "track the probe's target through the frames of two cameras"),
    Verb("freehand", "put tracked B-scans into a volume, for 3D Slicer too"),
    Verb("segment", "find masses or a tube in tracked B-scans, as closed surfaces in the world"),
    Verb("fuse", "put skin, masses and B-scans into one picture with layers"),
    Verb("project", "draw masses, a planned cut and the B-scan's line for the projector, onto the skin"),
    Verb("reconstruct", "reconstruct all that a capture holds: calibrations, skin, volumes, masses"),
    Verb("navigate", "follow the probe and tools live: the B-scan in place, skin and masses around it"),
    Verb("mentor", "light on the skin what a colleague elsewhere draws on camera 1's picture"),
    Verb("import", "read another group's data set into a capture"),
    Verb("import-sweep", "read a scanner's clip and a tracker's poses into a capture"),
    Verb("export", "write a capture in another group's layout, or results as a DICOM study"),
    Verb("import-results", "read a DICOM study of a volume, masses and surfaces"),
    Verb("evaluate", "compare a surface with a rendered capture's ground truth"),
    Verb("compare-twin", "render a real capture again with its identified rig, and say what the twin doesn't explain"),
    Verb("predict", "predict a rig's error on a plane before anything is recorded, and what would lower it"),
    Verb("accuracy", "measure errors of the twin's rig and compare with the paper's figures"),
    Verb("study", "repeat an experiment over settings and seeds: tables, plots, limits"),
    Verb("train", "train a network of the tracker with a data set"),
)

USAGE = """\
usage: sonotwin VERB [field=value ...]
       sonotwin VERB --help

{verbs}

`sonotwin VERB --help` shows a verb's fields with their defaults; nested ones are written with dots, and
group=choice takes another file of a group, or one of your own, which may begin with `defaults: [meza2021]`:
`rig=ours.yaml rig.projector.gamma=1.0`. In a shell, put a path with blanks in quotes: `sonotwin surface "out=outputs/my run"`.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # of a damaged image we say so ourselves, in one line
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of what is loaded from now on, see `linear_algebra`
    if isinstance(sys.stdout, TextIOWrapper):  # names of files may hold what the terminal has no letters for
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with _signals_interrupt():
            status = _run(sys.argv[1:] if arguments is None else list(arguments))
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader, such as `head`, has seen enough; nothing more may be flushed at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + BROKEN_PIPE
    except InputError as error:
        return _complain(str(error))
    except ModuleNotFoundError as error:
        hint = _how_to_install(error.name or "")
        if hint is None:
            raise
        return _complain(hint)
    except OSError as error:
        if error.errno is None:
            raise
        return _complain(f"{error.filename or 'output'}: {error.strerror}")
    except Ended as error:
        return _complain("ended by the system", status=128 + error.number)
    except KeyboardInterrupt:
        return _complain("interrupted", status=130)


class Ended(KeyboardInterrupt):
    """The system has asked this process to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let signals that ask for an end raise `Ended`, once: cleaning up isn't interrupted by a second one."""
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # Windows has no SIGHUP
    numbers = [number for number in map(signal.Signals.__getitem__, names) if signal.getsignal(number) == signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        numbers = []

    def end(number: int, frame: object) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise Ended(number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        width = max(len(verb.name) for verb in VERBS)
        print(USAGE.format(verbs="\n".join(f"  {verb.name:{width}}  {verb.summary}" for verb in VERBS)), end="")
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"sonotwin {version('sonotwin')}")
        return 0
    verb = _find(arguments[0])
    overrides = arguments[1:]
    if "-h" in overrides or "--help" in overrides:
        from sonotwin import verb_help

        name = next((one.removeprefix("name=") for one in reversed(overrides) if one.startswith("name=")), "sweep")
        described = verb.name == "study" and name != "sweep"  # a sweep has no file
        print(verb_help.of_study(name) if described else verb_help.text(verb.name, verb.module))
        return 0
    for override in overrides:
        if override.startswith("-"):
            raise InputError(f"{verb.name}: {override}: unknown option; fields are given as field=value")
    from recon import interrupts, linear_algebra
    from sonotwin import config, first_use

    first_use.announce()  # imports may compile, too
    with interrupts.held_back():  # an interrupt leaves extensions half imported, and other libraries' errors would hide it
        module = import_module(verb.module)
        settings = config.load(verb.name, overrides, module.Config)
    with linear_algebra.on_one_thread():
        return module.run(settings) or 0


def _find(name: str) -> Verb:
    for verb in VERBS:
        if verb.name == name:
            return verb
    names = [verb.name for verb in VERBS]
    close = get_close_matches(name, names, n=1)
    advice = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(names)}"
    raise InputError(f"{name}: unknown verb; {advice}")


def _complain(message: str, status: int = 2) -> int:
    print(f"sonotwin: {' '.join(message.splitlines())}", file=sys.stderr)
    return status


def _how_to_install(module: str) -> str | None:
    """Say how to get a missing package, or None if it is none of sonotwin's requirements."""
    from sonotwin.installation import extra_of, how_to_install

    extra = extra_of(module)
    if extra is None:
        return None
    return f"the Python package {module.partition('.')[0]} is missing; run {how_to_install(extra)}"
