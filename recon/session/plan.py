"""The experiment: the steps that a capture allows, in their order, each in a folder of its own, and why one is left out."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import model_validator

from recon import linear_algebra
from recon.capture import calibration_files, lag_files, manifest, probe_files, target_files
from recon.capture.manifest import CAMERAS, MANIFEST, SCANNER, Manifest, SweepPart, is_sweep, sweep_part
from recon.errors import Implausible, InputError
from recon.files import atomic, json_text, metrics
from recon.freehand.scans import TissueFields
from recon.model.rig import PATIENT, Finite, NotNegative, Probe, Rig
from recon.model.tracks import LagSeconds
from recon.probe_calibration import sound_in_water
from recon.registry import Choice
from recon.rig_check.optics_equations import PROJECTOR
from recon.session import (
    drift_step,
    latency_step,
    masses_step,
    optics_step,
    poses_step,
    probe_step,
    scene_step,
    skin_step,
    store,
    volume_step,
)
from recon.session.settings import (
    BarFields,
    BoardLengthField,
    BodyTargetFields,
    EchoFields,
    ScaleFields,
    Spacing,
    TargetField,
)
from recon.session.store import Store, files_of
from recon.session.tracker_settings import TrackingFields
from recon.session.watch import SILENT, Watch
from recon.tracking import networks

NO_OPTICS = "no calibration of the cameras: no board, and none given"
NO_PROBE = "no calibration of the probe: no sweep over crossed wires, and none given"
NO_LAG = "latency failed; give lag_s"
ONE_CAMERA = "fringes before one camera alone: what drifted parts skin and target by a tenth of a millimetre, unseen"
WITHIN = 0.2  # of usual drift, that devices drift within a session: fringes and films were taken at other moments; assumed
Command = Callable[[optics_step.Settings, Path], str]


class Settings(EchoFields, TissueFields, TargetField, BodyTargetFields, BoardLengthField, BarFields, TrackingFields, ScaleFields):
    """Source, and what is known beforehand."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design, and rig.probe: where the bracket holds the probe, and the scanner's mm/px"""
    capture: Path
    """a capture folder with any parts, as docs/captures.md describes"""
    camera: str = "cam1"
    """which camera's fringes the surface is made of"""
    calibration: Path | None = None
    """file: cameras and projector, in place of those from the board or in the capture"""
    probe: Path | None = None
    """file: the probe's calibration, in place of that from crossed wires or in the capture"""
    lag_s: LagSeconds | None = None
    """s, delay of the B-scans' time stamps, in place of that from a flat bottom"""
    lag_sigma_s: NotNegative = 0.0
    """s, standard deviation of a lag_s that is given"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them. Likewise images
    by light that make no scene"""
    temperature_c: Finite | None = None
    """deg C, of the water about the wires; null leaves depths right for that water. Needed of another scanner"""
    spacing_mm: Spacing = 0.5
    """mm, of a volume's voxels; 0.01 to 100"""
    find: Literal["masses", "tube", "nothing"] = "masses"
    """in the B-scans: masses, which differ from the tissue around them; tube, round, in water, and the body about it; nothing"""
    overlays: bool = False
    """pictures of every pair of tracked frames, 0.1 MB and some hundredths of a second each"""
    reference: Path | None = None
    """file: the pose of the body `patient` at which the skin was measured, as of `sonotwin track`; null: as that finds it, in the
    fringe images, or else in the first sweep over the patient"""

    @model_validator(mode="after")
    def _sigma_of_a_lag(self) -> "Settings":
        if self.lag_sigma_s and self.lag_s is None:
            raise ValueError(f"lag_sigma_s: expected with a lag_s that is given, found {self.lag_sigma_s:g} without")
        return self


class KnownLag(NamedTuple):
    """The lag of the scanner's images behind the poses; nothing where it is assumed, as each step assumes it with its sigma."""

    lag_s: float | None = None
    sigma_s: float | None = None


@dataclass(frozen=True)
class Sources:
    """What all steps read: the settings, and the capture's parts."""

    settings: Settings
    held: Manifest
    usual: Probe
    watch: Watch
    command: Command

    @property
    def sweeps(self) -> dict[str, SweepPart]:
        """Sweeps by name."""
        return self.held.named_sweeps

    def files(self, *parts: str) -> dict[str, object]:
        """Files of some parts, by which a step's inputs are known."""
        root = self.settings.capture / self.held.root
        paths = [root / name for part in parts for name in self.held.part(part).paths()]
        folders = sorted({path if is_sweep(part) else path.parent for part in parts for path in paths})
        described = {part: self.held.part(part).model_dump(mode="json") for part in parts}
        return {"files": files_of(folders), "parts": described, "devices": self.held.model_dump(mode="json")["devices"]}


@linear_algebra.on_one_thread()
def run(settings: Settings, out: Path, code: str, usual: Probe, command: Command, watch: Watch = SILENT) -> Store:
    """Do all steps that the capture allows; returns what was done, and what could not be.

    Parameters
    ----------
    code : digest of the code that does the steps
    usual : the probe of the usual rig, beside which it shows whether a scale was given
    command : the command line that calibrates the optics likewise, for their page

    Raises
    ------
    InputError
        If the manifest is wrong, a given file is missing, or `out` can't be written to.
    """
    sources = Sources(settings, manifest.read_manifest(settings.capture), usual, watch, command)
    steps = Store(out, watch.announce, code)
    files = settings.calibration, settings.target, settings.probe, settings.networks, settings.reference
    given = (*files, *settings.bars, *settings.measured.values())
    check(sources)
    with steps.opened([settings.capture, *given]):
        calibrated = calibrate_optics(steps, sources)
        optics = correct_optics(steps, sources, calibrated)
        skin = measure_skin(steps, sources, optics)
        tracked = {name: track_sweep(steps, sources, name, optics, optics != calibrated) for name in sources.sweeps}
        lag = measure_latency(steps, sources, tracked)
        probe = calibrate_probe(steps, sources, tracked, lag)
        for name, part in sources.sweeps.items():
            if part.purpose in (None, "volume") and SCANNER in part.images:
                look_inside(steps, sources, name, tracked[name], probe, lag, skin, optics)
        with atomic.listed_file(out, metrics.FILE, store.BY) as temporary:
            metrics.write(temporary, figures(out, steps))
    if not steps.done:
        watch.say("nothing     could be done: give what was left out, such as calibration=FILE, probe=FILE")
    watch.say(f"wrote       {out}/{{{','.join([*steps.done, metrics.FILE])}}}")
    return steps


def check(sources: Sources) -> None:
    """Check, before any long work, what can be known beforehand.

    Raises
    ------
    InputError
        If a given file is missing or damaged, the capture has no part, its fringes are of another camera, or water has no such
        temperature.
    """
    settings, held = sources.settings, sources.held
    for key in ("calibration", "target", "probe"):
        given: Path | None = getattr(settings, key)
        if given is not None and not given.is_file():
            raise InputError(f"{key}: expected a file, found {'a folder' if given.is_dir() else 'nothing'} at {given}")
    if settings.calibration is not None:
        calibration_files.read(settings.calibration)
    if settings.target is not None:
        target_files.read(settings.target, settings.rig.target)
    if settings.probe is not None:
        probe_files.read(settings.probe)
    for bar in settings.bars:
        manifest.read_manifest(bar)
    if settings.board_length_mm is not None and not is_by_board(sources):
        found = "none in the capture" if held.board is None else "another calibration in its place"
        raise InputError(f"board_length_mm: expected beside a board that the optics are calibrated by, found {found}")
    if settings.networks is not None and not settings.networks.exists():
        raise InputError(f"networks: expected a folder or a file, found nothing at {settings.networks}")
    path = settings.capture / MANIFEST
    if not held.contents:
        raise InputError(f"{path}: expected a surface, a board or a sweep, found none of them")
    if held.surface is not None and settings.camera not in held.surface.images:
        raise InputError(
            f"{path}: surface.images: expected {settings.camera}, found {', '.join(held.surface.images)}; give camera=..."
        )
    if settings.temperature_c is not None:
        sound_in_water.speed_of_sound(settings.temperature_c)


def is_by_board(sources: Sources) -> bool:
    """Whether the optics are calibrated by the capture's board, not as given, or as the capture has them for its fringes."""
    held = sources.held
    lit = held.board is None or held.board.patterns is not None
    return sources.settings.calibration is None and held.board is not None and (lit or not (held.surface and held.calibration))


def calibrate_optics(steps: Store, sources: Sources) -> Path | None:
    """Calibrate cameras and projector by the board, or take the calibration given, or the capture's own; returns its file."""
    settings, held = sources.settings, sources.held
    own = None if held.calibration is None else settings.capture / held.calibration
    if settings.calibration is not None:
        return steps.take("optics", settings.calibration, "as given" if held.board is None else "as given; the board isn't used")
    if held.board is None:
        return None if own is None else steps.take("optics", own, "the capture's own, as it has no board")
    if not is_by_board(sources):
        steps.leave_out("optics", f"the board was seen without fringes, and so not by the projector; {own} is used")
        return own

    def work(by_board: optics_step.Settings, out: Path) -> None:
        optics_step.run(by_board, out, sources.command(by_board, out), sources.watch)

    does, same = "cameras and projector, from the board", ("capture", "board_scale", "board_length_mm")
    fields = {field: getattr(settings, field) for field in same}
    made = steps.do("optics", does, optics_step.BY, optics_step.Settings, fields, work, sources.files("board"))
    return None if made is None else made / optics_step.OPTICS


def correct_optics(steps: Store, sources: Sources, optics: Path | None) -> Path | None:
    """Correct the calibration for drift by what the session shows of it; returns its file, that of before where it can't be.

    Without fringes before both cameras it isn't: views of the target alone leave most of what parts skin and target.
    """
    settings, held = sources.settings, sources.held
    filmed = [sweep_part(name) for name, part in sources.sweeps.items() if set(CAMERAS) <= part.images.keys()]
    lit = held.surface is not None and set(CAMERAS) <= held.surface.images.keys()
    bar = "; the ball bar isn't used" if settings.bars else ""
    if optics is None or held.surface is None or settings.drift_px == 0:
        if bar:
            steps.leave_out("drift", f"no calibration, no fringes on the skin, or drift_px=0{bar}")
        return optics
    try:
        known = calibration_files.read(optics).cameras
    except InputError as error:
        steps.fail("drift", f"{error}{bar}")
        return optics
    if missing := [name for name in (*CAMERAS, PROJECTOR) if name not in known]:
        steps.leave_out("drift", f"no calibration of {' and '.join(missing)}{bar}")
        return optics
    if not lit:
        steps.leave_out("drift", f"{ONE_CAMERA}{bar}")
        return optics
    same = ("rig", "capture", "naming", "drift_px", "board_scale", "target", "networks", "bars", "bar_mm", "ball_mm")
    fields = {field: getattr(settings, field) for field in same} | {
        "calibration": optics,
        "board_scale": scale_left(steps, settings),
    }
    given = [settings.networks or networks.WEIGHTS, *filter(None, [settings.target]), *images_of(settings.bars)]
    made_of = sources.files("surface", *filmed) | _known_by(steps, "optics", optics, *given)
    does, work = "the calibration, corrected for drift", partial(drift_step.run, watch=sources.watch)
    made = steps.do("drift", does, drift_step.BY, drift_step.Settings, fields, work, made_of)
    return optics if made is None else made / drift_step.OPTICS


def scale_left(steps: Store, settings: Settings) -> float | None:
    """The board's scale that a calibration doesn't have in its covariance; None of one that this session made, which has it."""
    return None if "optics" in steps.done else settings.board_scale


def images_of(captures: Iterable[Path]) -> Iterator[Path]:
    """Manifests, and files of the surfaces, of some captures."""
    for capture in captures:
        held = manifest.read_manifest(capture)
        yield capture / MANIFEST
        yield from (capture / held.root / name for name in ([] if held.surface is None else held.part("surface").paths()))


def measure_skin(steps: Store, sources: Sources, optics: Path | None) -> Path | None:
    """Measure the surface by light; returns its file."""
    settings = sources.settings
    if sources.held.surface is None:
        return None
    if optics is None:
        return steps.leave_out("surface", _no(steps, "optics", NO_OPTICS))
    fields = {
        "capture": settings.capture,
        "calibration": optics,
        "camera": settings.camera,
        "implausible": settings.implausible,
    }
    made_of = sources.files("surface") | _known_by(steps, "optics", optics)
    does, work = "the surface, from fringes", partial(skin_step.run, watch=sources.watch)
    made = steps.do("surface", does, skin_step.BY, skin_step.Settings, fields, work, made_of)
    return None if made is None else made / skin_step.SKIN


def track_sweep(steps: Store, sources: Sources, name: str, optics: Path | None, corrected: bool) -> Path | None:
    """Track the target in a sweep's frames; returns a capture in which it has poses, the sweep's own where it has a track.

    corrected : whether the calibration is one for drift, with a covariance that has the board's scale
    """
    settings, part, step = sources.settings, sources.sweeps[name], _step_of("poses", name)
    filmed = set(CAMERAS) <= part.images.keys()
    if part.track is not None and (optics is None or not filmed):
        return settings.capture
    if not filmed:
        return steps.leave_out(step, f"neither frames of {' and '.join(CAMERAS)} nor a track")
    if optics is None:
        return steps.leave_out(step, _no(steps, "optics", NO_OPTICS))
    same = ("rig", "capture", "naming", "drift_px", "board_scale", "target", "measured", "networks", "overlays")
    fields = {field: getattr(settings, field) for field in same} | {"sweep": name, "calibration": optics}
    fields["board_scale"] = scale_left(steps, settings)
    if corrected and calibration_files.read(optics).uncertainty is not None:
        fields |= {"drift_px": WITHIN * settings.drift_px, "board_scale": None}
    weights = settings.networks or networks.WEIGHTS
    measured = [*filter(None, [settings.target]), *settings.measured.values()]
    made_of = sources.files(sweep_part(name)) | _known_by(steps, "optics", optics, weights, *measured)
    if PATIENT in settings.rig.bodies and part.purpose in ("volume", None):
        fields["reference"] = settings.reference or _earlier_reference(steps, sources, name)
        told_by = [] if sources.held.surface is None else sources.files("surface")
        made_of |= {"reference": told_by if fields["reference"] is None else files_of([fields["reference"]])}
    does, work = "poses of the probe, from frames", partial(poses_step.run, watch=sources.watch)
    return steps.do(step, does, poses_step.BY, poses_step.Settings, fields, work, made_of)


def _earlier_reference(steps: Store, sources: Sources, name: str) -> Path | None:
    """Where the patient stood in the first sweep, of a capture without fringes, so that all its sweeps are told in one world."""
    if sources.held.surface is not None:
        return None
    done = [step for other in sources.sweeps if other != name and (step := _step_of("poses", other)) in steps.done]
    return next((path for step in done if (path := steps.folder / step / poses_step.REFERENCE).is_file()), None)


def measure_latency(steps: Store, sources: Sources, tracked: Mapping[str, Path | None]) -> KnownLag | None:
    """Measure the scanner's latency by the last sweep over a flat bottom, or take the one given; None if that failed.

    Without either a lag of nothing, for which each step assumes 0 with a sigma of its own.
    """
    settings, name = sources.settings, _last(sources, "latency")
    if settings.lag_s is not None:
        return KnownLag(settings.lag_s, settings.lag_sigma_s)
    if name is None:
        steps.leave_out("latency", "no sweep over a flat bottom and no lag_s; the B-scans' time stamps are taken as they are")
        return KnownLag()
    if tracked[name] is None:
        return steps.fail("latency", f"no poses of the sweep {name}")
    fields = {"capture": tracked[name], "sweep": name, "implausible": settings.implausible}
    does, made_of = "the scanner's lag, from a flat bottom", _scans(steps, sources, name)
    work = partial(latency_step.run, watch=sources.watch)
    made = steps.do("latency", does, latency_step.BY, latency_step.Settings, fields, work, made_of)
    return None if made is None else read_lag(made)


def optics_used(out: Path) -> Path | None:
    """The calibration by which all in a folder of results was measured; None for the capture's own."""
    done = json_text.read(out / store.RECORD)
    files = {"drift": drift_step.OPTICS, "optics": optics_step.OPTICS}
    return next((out / step / file for step, file in files.items() if step in done), None)


def is_corrected(out: Path) -> bool:
    """Whether all in a folder of results was measured by a calibration corrected for drift."""
    return "drift" in json_text.read(out / store.RECORD)


def read_lag(folder: Path) -> KnownLag:
    """The lag that `sonotwin measure-lag` wrote into a folder; InputError as of `recon.capture.lag_files.read`."""
    found = lag_files.read(folder / lag_files.FILE)
    return KnownLag(found.lag_s, found.sigma_s)


def calibrate_probe(steps: Store, sources: Sources, tracked: Mapping[str, Path | None], lag: KnownLag | None) -> Path | None:
    """Calibrate the probe by the last sweep over crossed wires, or take the one given, or the capture's; returns its file."""
    settings, name = sources.settings, _last(sources, "probe")
    if settings.probe is not None:
        return steps.take("probe", settings.probe, "as given")
    if name is None:
        return None if sources.held.probe is None else _own_probe(steps, settings, settings.capture / sources.held.probe)
    if tracked[name] is None or lag is None:
        return steps.fail("probe", NO_LAG if lag is None else f"no poses of the sweep {name}; give probe=...")
    fields = {field: getattr(settings, field) for field in ("rig", "implausible", "temperature_c", "scale_given")}
    fields |= {"capture": tracked[name], "sweep": name, "lag_s": lag.lag_s, "lag_sigma_s": lag.sigma_s}
    does, made_of = "the ultrasound probe, from crossed wires", _scans(steps, sources, name)
    work = partial(probe_step.run, usual=sources.usual, watch=sources.watch)
    made = steps.do("probe", does, probe_step.BY, probe_step.Settings, fields, work, made_of)
    return None if made is None else made / probe_step.PROBE


def _own_probe(steps: Store, settings: Settings, own: Path) -> Path:
    """The calibration that the capture has, as it has no wires."""
    unused = "" if settings.temperature_c is None else "; temperature_c is for wires, and isn't used"
    return steps.take("probe", own, f"the capture's own, as it has no sweep over crossed wires{unused}")


def look_inside(
    steps: Store,
    sources: Sources,
    name: str,
    capture: Path | None,
    probe: Path | None,
    lag: KnownLag | None,
    skin: Path | None,
    optics: Path | None,
) -> None:
    """Make the volume of a sweep, and look for masses or a tube in its B-scans."""
    settings, volume = sources.settings, _step_of("volume", name)
    if capture is None or lag is None or probe is None:
        no_poses = f"no poses of the sweep {name}".rstrip()
        reason = no_poses if capture is None else NO_LAG if lag is None else _no(steps, "probe", NO_PROBE)
        wanted = {"masses": ("volume", "masses", "scene"), "tube": ("volume", "tube"), "nothing": ("volume",)}[settings.find]
        for kind in wanted:
            steps.leave_out(_step_of(kind, name), reason)
        return None
    seen = {"capture": capture, "sweep": name, "probe": probe, "implausible": settings.implausible}
    placed = seen | {field: getattr(settings, field) for field in ("tissue_m_s", "tissue_sigma_m_s")}
    placed |= {"lag_s": lag.lag_s, "lag_sigma_s": lag.sigma_s}
    does, fields = "B-scans in a volume", placed | {"spacing_mm": settings.spacing_mm}
    made_of = _scans(steps, sources, name) | _known_by(steps, "probe", probe)
    work = partial(volume_step.run, watch=sources.watch)
    voxels = steps.do(volume, does, volume_step.BY, volume_step.Settings, fields, work, made_of)
    if settings.find == "nothing":
        return None
    if skin is not None:
        made_of |= {"skin": steps.digest("surface")}
    does, found = f"{'masses' if settings.find == 'masses' else 'a tube'} in the B-scans", _step_of(settings.find, name)
    fields = placed | {"surface": skin, "kind": settings.find, "spread_mm": settings.spread_mm, "slice_mm": settings.slice_mm}
    work = partial(masses_step.run, watch=sources.watch)
    masses = steps.do(found, does, masses_step.BY, masses_step.Settings, fields, work, made_of)
    if settings.find == "masses":
        fields = seen | show_together(settings, lag, skin, optics, masses, voxels)
        why = steps.failed.get(found, "")
        made_of |= {"masses": [steps.digest(found), why], "volume": steps.digest(volume)}
        made_of |= _known_by(steps, "optics", *filter(None, [optics]))
        does, work = "all of it in one picture", partial(scene_step.run, watch=sources.watch, search_failed=why)
        steps.do(_step_of("scene", name), does, scene_step.BY, scene_step.Settings, fields, work, made_of)
    return None


def show_together(
    settings: Settings,
    lag: KnownLag,
    skin: Path | None,
    optics: Path | None,
    masses: Path | None,
    volume: Path | None,
) -> dict[str, Any]:
    """Fields of a scene by which all that was found about a sweep is put into one picture."""
    own = {"rig": settings.rig, "tissue_m_s": settings.tissue_m_s, "lag_s": lag.lag_s or 0.0}
    return own | {"surface": skin, "masses": masses, "volume": volume, "calibration": optics}


def kept_scene(settings: Settings, out: Path, sweep: str, optics: Path | None) -> scene_step.Settings:
    """Settings by which the results in a folder, of a run that left nothing out, are in one picture.

    optics : the calibration that all was measured with; None for the capture's own

    Raises
    ------
    InputError
        If the folder has no lag.
    """
    lag, skin = read_lag(out / "latency"), out / "surface" / skin_step.SKIN
    shown = show_together(settings, lag, skin, optics, out / "masses" / sweep, out / "volume" / sweep)
    probe = out / "probe" / probe_step.PROBE
    seen = {"capture": out / "poses" / sweep, "sweep": sweep, "probe": probe, "implausible": settings.implausible}
    return scene_step.Settings.model_validate(seen | shown)


def figures(out: Path, steps: Store) -> metrics.Metrics:
    """Figures of all steps that are done, less those of the clock, by the step's name."""
    found: metrics.Metrics = {}
    for name in steps.done:
        read = metrics.read(out / name / metrics.FILE)
        timeless = {key: value for key, value in read.items() if not key.startswith("seconds_") and key != "frames_per_s"}
        found |= {f"{name.replace('/', '_')}_{key}": value for key, value in timeless.items()}
    return found


def _step_of(kind: str, sweep: str) -> str:
    """Name of the step of a kind that a sweep has to itself."""
    return f"{kind}/{sweep}" if sweep else kind


def _no(steps: Store, step: str, reason: str) -> str:
    """The reason for what is missing: the step that should have made it failed, or there was none."""
    return f"{step} failed" if step in steps.failed else reason


def _last(sources: Sources, purpose: str) -> str | None:
    """The last sweep for a purpose that has B-scans; None without one."""
    fitting = [name for name, part in sources.sweeps.items() if part.purpose == purpose and SCANNER in part.images]
    return fitting[-1] if fitting else None


def _scans(steps: Store, sources: Sources, name: str) -> dict[str, object]:
    """Inputs of a step that reads a sweep's B-scans and poses."""
    return sources.files(sweep_part(name)) | {"poses": steps.digest(_step_of("poses", name))}


def _known_by(steps: Store, step: str, *files: Path) -> dict[str, object]:
    """Digest of an earlier step, and of the files that it made or that stand in its place."""
    return {step: [steps.digest(step), files_of(files)]}
