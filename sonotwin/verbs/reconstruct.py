"""Reconstruct all that a capture holds, from its images to masses under the skin, in one frame.

Reads a capture folder, recorded or rendered, and uses each part that is there: the board for the optics, fringes for the skin,
frames of both cameras for the poses of its sweeps, a flat bottom for the scanner's latency, crossed wires for the probe, B-scans
for volumes and masses. What is missing is taken from the calibrations given here or in the capture, or left out by name.

Writes into the folder `out`, each step in a folder of its own as its verb would: optics/, surface/, poses/NAME/, latency/,
probe/, volume/NAME/, masses/NAME/ or tube/NAME/, and scene/NAME/ (of a sweep without a name poses/, volume/ ...); and
metrics.json, the figures of all steps. A step whose result is there, made of the same, isn't done again, so a run that was killed
is simply started again. Takes minutes. Exit status 1 if a step failed, those that build on it are
left out, or if none could be done.

    sonotwin reconstruct capture=session/capture out=result
    sonotwin reconstruct capture=session/capture tissue_m_s=1450 temperature_c=22 out=result
    sonotwin reconstruct capture=session/capture calibration=optics.yaml probe=probe.yaml lag_s=0.05 out=result
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator
from rich.console import Console

from recon.capture import calibration_files, lag_files, manifest, probe_files, target_files
from recon.capture.manifest import CAMERAS, MANIFEST, SCANNER, Manifest, SweepPart, is_sweep, sweep_part
from recon.errors import Implausible, InputError
from recon.files import atomic, metrics
from recon.files.code_digest import code_digest
from recon.model.calibration import DRIFT_PX, PRINT_SCALE
from recon.model.probe import Speed, SpeedSigma
from recon.model.rig import Finite, NotNegative, Positive, Rig
from recon.model.tracks import LagSeconds
from recon.probe_calibration import sound_in_water
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from recon.session import store
from recon.session.store import Store, files_of
from recon.tracking import networks
from recon.tracking.results import POSES
from sonotwin.config import Choice
from sonotwin.config import folder as conf
from sonotwin.verbs import calibrate_optics, calibrate_probe, freehand, fuse, measure_lag, segment, surface, track

Drift = Annotated[float, Field(ge=0, le=10)]
NO_OPTICS = "no calibration of the cameras: no board, and none given"
NO_PROBE = "no calibration of the probe: no sweep over crossed wires, and none given"
NO_LAG = "latency failed; give lag_s"
SKIN = "surface.ply"


class Config(calibrate_probe.ScaleFields):
    """Fields of `sonotwin reconstruct`: source, target, and what is known beforehand."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design, and rig.probe: where the bracket holds the probe, and the scanner's mm/px"""
    capture: Path
    """a capture folder with any parts, as docs/captures.md describes"""
    out: Path
    """folder; gets a folder a step, and metrics.json; what is there and made of the same is kept"""
    camera: str = "cam1"
    """which camera's fringes the surface is made of"""
    calibration: Path | None = None
    """file: cameras and projector, in place of those from the board or in the capture"""
    drift_px: Drift = DRIFT_PX
    """px, standard deviation of principal points since the calibration: warmth, a turned mount; focal lengths by 4e-4 of it,
    relative"""
    board_scale: Annotated[float, Field(ge=0, le=0.1)] = PRINT_SCALE
    """relative standard deviation of the scale of the board that the cameras were calibrated with, where the calibration has
    less: of paper by moisture; 1e-5 of chrome on glass"""
    target: Path | None = None
    """file of `sonotwin calibrate-target`: the target as it was measured, instead of the design's"""
    networks: Path | None = None
    """folder of detector.onnx and segmenter.onnx; null for those that come with sonotwin"""
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
    tissue_m_s: Speed | None = None
    """m/s, of sound in what was scanned: 1540 on average, 1440 to 1480 in fat, 1450 in soft silicone"""
    tissue_sigma_m_s: SpeedSigma | None = None
    """m/s, standard deviation of the former; null: 25, of tissue that is known by its kind alone, or 50 without it"""
    spacing_mm: Positive = 0.5
    """mm, of a volume's voxels"""
    find: Literal["masses", "tube", "nothing"] = "masses"
    """in the B-scans: masses, darker than the tissue around them; tube, round, in water, and the body about it; nothing"""
    spread_mm: segment.Spreads = SPREAD_MM
    """mm, of an echo along the array and in depth; as `sonotwin segment` takes it"""
    slice_mm: segment.Slice = SLICE_MM
    """mm, likewise: depth and sigma of an echo across the image plane there; null leaves lobes as flat as they are found, and
    edges of shadows sharp"""
    overlays: bool = False
    """pictures of every pair of tracked frames, 0.1 MB and some hundredths of a second each"""

    @model_validator(mode="after")
    def _sigma_of_a_lag(self) -> "Config":
        if self.lag_sigma_s and self.lag_s is None:
            raise ValueError(f"lag_sigma_s: expected with a lag_s that is given, found {self.lag_sigma_s:g} without")
        return self


class Lag(NamedTuple):
    """The lag of the scanner's images behind the poses, as fields of the steps that place B-scans."""

    lag_s: float = 0.0
    sigma_s: float | None = None  # None where the lag is assumed, for want of a measured or a given one

    @property
    def fields(self) -> dict[str, object]:
        """The lag and its standard deviation; none of one that is assumed, as each step assumes it too, with its uncertainty."""
        return {} if self.sigma_s is None else {"lag_s": self.lag_s, "lag_sigma_s": self.sigma_s}


@dataclass(frozen=True)
class Sources:
    """What all steps read: the settings, and the capture's parts."""

    config: Config
    held: Manifest

    @property
    def sweeps(self) -> dict[str, SweepPart]:
        """Sweeps by name."""
        return self.held.named_sweeps

    def files(self, *parts: str) -> dict[str, object]:
        """Files of some parts, by which a step's inputs are known."""
        root = self.config.capture / self.held.root
        paths = [root / name for part in parts for name in self.held.part(part).paths()]
        folders = sorted({path if is_sweep(part) else path.parent for part in parts for path in paths})
        described = {part: self.held.part(part).model_dump(mode="json") for part in parts}
        return {"files": files_of(folders), "parts": described, "devices": self.held.model_dump(mode="json")["devices"]}


def run(config: Config) -> int:
    """Do all steps that the capture allows; returns 1 if a part could not be used, or none.

    Raises
    ------
    InputError
        If the manifest is wrong, a given file is missing, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    sources = Sources(config, manifest.read_manifest(config.capture))
    code = code_digest("recon", "sonotwin", conf())
    steps = Store(config.out, lambda line: console.print(line, style="bold cyan", markup=False), code)
    given = [path for path in (config.calibration, config.target, config.probe, config.networks) if path is not None]
    check(sources)
    with steps.opened([config.capture, *given]):
        optics = calibrated_optics(steps, sources)
        skin = measured_skin(steps, sources, optics)
        tracked = {name: tracked_sweep(steps, sources, name, optics) for name in sources.sweeps}
        lag = measured_latency(steps, sources, tracked)
        probe = calibrated_probe(steps, sources, tracked, lag)
        for name, part in sources.sweeps.items():
            if part.purpose in (None, "volume") and SCANNER in part.images:
                look_inside(steps, sources, name, tracked[name], probe, lag, skin, optics)
        with atomic.listed_file(config.out, metrics.FILE, store.BY) as temporary:
            metrics.write(temporary, figures(config.out, steps))
    if not steps.done:
        console.print("nothing     could be done: give what was left out, such as calibration=FILE, probe=FILE", markup=False)
    console.print(f"wrote       {config.out}/{{{','.join([*steps.done, metrics.FILE])}}}", markup=False)
    return 1 if steps.failed or not steps.done else 0


def check(sources: Sources) -> None:
    """Check, before any long work, what can be known beforehand.

    Raises
    ------
    InputError
        If a given file is missing or damaged, the capture has no part, its fringes are of another camera, or water has no such
        temperature.
    """
    config, held = sources.config, sources.held
    for key in ("calibration", "target", "probe"):
        given: Path | None = getattr(config, key)
        if given is not None and not given.is_file():
            raise InputError(f"{key}: expected a file, found {'a folder' if given.is_dir() else 'nothing'} at {given}")
    if config.calibration is not None:
        calibration_files.read(config.calibration)
    if config.target is not None:
        target_files.read(config.target, config.rig.target)
    if config.probe is not None:
        probe_files.read(config.probe)
    if config.networks is not None and not config.networks.exists():
        raise InputError(f"networks: expected a folder or a file, found nothing at {config.networks}")
    path = config.capture / MANIFEST
    if not held.contents:
        raise InputError(f"{path}: expected a surface, a board or a sweep, found none of them")
    if held.surface is not None and config.camera not in held.surface.images:
        raise InputError(
            f"{path}: surface.images: expected {config.camera}, found {', '.join(held.surface.images)}; give camera=..."
        )
    if config.temperature_c is not None:
        sound_in_water.speed_of_sound(config.temperature_c)


def calibrated_optics(steps: Store, sources: Sources) -> Path | None:
    """The calibration of cameras and projector: the one given, the board's, or the capture's own."""
    config, held = sources.config, sources.held
    own = None if held.calibration is None else config.capture / held.calibration
    if config.calibration is not None:
        return steps.take("optics", config.calibration, "as given")
    if held.board is None:
        return None if own is None else steps.take("optics", own, "the capture's own, as it has no board")
    if held.board.patterns is None and held.surface is not None and own is not None:
        steps.leave_out("optics", f"the board was seen without fringes, and so not by the projector; {own} is used")
        return own
    fields, files = {"capture": config.capture}, (calibrate_optics.OPTICS, calibrate_optics.PAGE)
    made = steps.do("optics", "cameras and projector, from the board", calibrate_optics, fields, files, sources.files("board"))
    return None if made is None else made / calibrate_optics.OPTICS


def measured_skin(steps: Store, sources: Sources, optics: Path | None) -> Path | None:
    """The surface by light."""
    config = sources.config
    if sources.held.surface is None:
        return None
    if optics is None:
        return steps.leave_out("surface", _no(steps, "optics", NO_OPTICS))
    fields = {"capture": config.capture, "calibration": optics, "camera": config.camera, "implausible": config.implausible}
    made_of = sources.files("surface") | _known_by(steps, "optics", optics)
    made = steps.do("surface", "the surface, from fringes", surface, fields, (surface.POINTS, SKIN), made_of)
    return None if made is None else made / SKIN


def tracked_sweep(steps: Store, sources: Sources, name: str, optics: Path | None) -> Path | None:
    """A capture in which the sweep has poses: made of the cameras' frames, or the capture itself, where it has a track."""
    config, part, step = sources.config, sources.sweeps[name], _step_of("poses", name)
    filmed = set(CAMERAS) <= part.images.keys()
    if part.track is not None and (optics is None or not filmed):
        return config.capture
    if not filmed:
        return steps.leave_out(step, f"neither frames of {' and '.join(CAMERAS)} nor a track")
    if optics is None:
        return steps.leave_out(step, _no(steps, "optics", NO_OPTICS))
    same = {"rig", "drift_px", "board_scale", "target", "networks", "overlays"}
    fields = {"capture": config.capture, "sweep": name, "calibration": optics, **{key: getattr(config, key) for key in same}}
    weights = config.networks or networks.WEIGHTS
    made_of = sources.files(sweep_part(name)) | _known_by(steps, "optics", optics, weights, *filter(None, [config.target]))
    files = (POSES, MANIFEST) if SCANNER in part.images else (POSES,)
    return steps.do(step, "poses of the probe, from frames", track, fields, files, made_of)


def measured_latency(steps: Store, sources: Sources, tracked: Mapping[str, Path | None]) -> Lag | None:
    """The scanner's latency: the one given, that of the last sweep over a flat bottom, or 0 without one; None if it failed."""
    config, name = sources.config, _last(sources, "latency")
    if config.lag_s is not None:
        return Lag(config.lag_s, config.lag_sigma_s)
    if name is None:
        steps.leave_out("latency", "no sweep over a flat bottom and no lag_s; the B-scans' time stamps are taken as they are")
        return Lag()
    if tracked[name] is None:
        return steps.fail("latency", f"no poses of the sweep {name}")
    fields = {"capture": tracked[name], "sweep": name, "implausible": config.implausible}
    does, made_of = "the scanner's lag, from a flat bottom", _scans(steps, sources, name)
    made = steps.do("latency", does, measure_lag, fields, (measure_lag.LAG,), made_of)
    return None if made is None else measured_lag(made)


def measured_lag(folder: Path) -> Lag:
    """The lag that `sonotwin measure-lag` wrote into a folder; InputError as of `recon.capture.lag_files.read`."""
    found = lag_files.read(folder / lag_files.FILE)
    return Lag(found.lag_s, found.sigma_s)


def calibrated_probe(steps: Store, sources: Sources, tracked: Mapping[str, Path | None], lag: Lag | None) -> Path | None:
    """The probe's calibration: the one given, that of the last sweep over crossed wires, or without one the capture's."""
    config, name = sources.config, _last(sources, "probe")
    if config.probe is not None:
        return steps.take("probe", config.probe, "as given")
    if name is None:
        return None if sources.held.probe is None else _own_probe(steps, config, config.capture / sources.held.probe)
    if tracked[name] is None or lag is None:
        return steps.fail("probe", NO_LAG if lag is None else f"no poses of the sweep {name}; give probe=...")
    fields = {"rig": config.rig, "capture": tracked[name], "sweep": name, "lag_s": lag.lag_s}
    fields |= {name: getattr(config, name) for name in ("implausible", "temperature_c", "scale_given")}
    does, made_of = "the ultrasound probe, from crossed wires", _scans(steps, sources, name)
    files = (calibrate_probe.PROBE, calibrate_probe.FRAMES)
    made = steps.do("probe", does, calibrate_probe, fields, files, made_of)
    return None if made is None else made / calibrate_probe.PROBE


def _own_probe(steps: Store, config: Config, own: Path) -> Path:
    """The calibration that the capture has, as it has no wires."""
    unused = "" if config.temperature_c is None else "; temperature_c is for wires, and isn't used"
    return steps.take("probe", own, f"the capture's own, as it has no sweep over crossed wires{unused}")


def look_inside(
    steps: Store,
    sources: Sources,
    name: str,
    capture: Path | None,
    probe: Path | None,
    lag: Lag | None,
    skin: Path | None,
    optics: Path | None,
) -> None:
    """The volume of a sweep, and what is found in its B-scans."""
    config, volume = sources.config, _step_of("volume", name)
    if capture is None or lag is None or probe is None:
        no_poses = f"no poses of the sweep {name}".rstrip()
        reason = no_poses if capture is None else NO_LAG if lag is None else _no(steps, "probe", NO_PROBE)
        wanted = {"masses": ("volume", "masses", "scene"), "tube": ("volume", "tube"), "nothing": ("volume",)}[config.find]
        for kind in wanted:
            steps.leave_out(_step_of(kind, name), reason)
        return None
    placing = {"capture": capture, "sweep": name, "probe": probe, "tissue_m_s": config.tissue_m_s}
    placing |= {"implausible": config.implausible}
    fields = placing | lag.fields | {"tissue_sigma_m_s": config.tissue_sigma_m_s}
    made_of = _scans(steps, sources, name) | _known_by(steps, "probe", probe)
    voxels = steps.do(
        volume, "B-scans in a volume", freehand, fields | {"spacing_mm": config.spacing_mm}, (freehand.VOLUME,), made_of
    )
    if config.find == "nothing":
        return None
    if skin is not None:
        fields, made_of = fields | {"surface": skin}, made_of | {"skin": steps.digest("surface")}
        placing |= {"surface": skin}
    does, found = f"{'masses' if config.find == 'masses' else 'a tube'} in the B-scans", _step_of(config.find, name)
    sought = {"kind": config.find, "spread_mm": config.spread_mm, "slice_mm": config.slice_mm}
    masses = steps.do(found, does, segment, fields | sought, (), made_of)
    if config.find == "masses":
        shown = placing | {"rig": config.rig, "lag_s": lag.lag_s, "masses": masses, "calibration": optics, "volume": voxels}
        made_of |= {"masses": steps.digest(found), "optics": steps.digest("optics"), "volume": steps.digest(volume)}
        steps.do(_step_of("scene", name), "all of it in one picture", fuse, shown, (fuse.SCENE,), made_of)
    return None


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
