"""Draw masses, a planned cut and the B-scan's line for the projector, so that its light shows them on the skin where they are.

Reads the skin as it lies now (`sonotwin surface`), masses of `sonotwin segment`, a cut drawn in 3D Slicer (.mrk.json), and a
capture's sweep with poses, as far as each is given. The outline of a mass is where the lines that touch it come through the skin:
parallel lines along the skin's normal over it, or those of the surgeon's eye (`eye_mm`); its name stands beside it. Where the
body has moved since, give the skin of that time as `earlier_skin`, and masses and cut move along. Writes into `out`:
projector.png, to be shown pixel by pixel; curves.json (mm) and curves.ply, the curves on the skin; scene.glb with skin, masses
and curves; expected_cam1.png, what camera 1 should see of it; and metrics.json. Takes some seconds, about one of them to draw.

With `show=true` and a laboratory's `devices` the projector, a second display, then shows the picture until Ctrl-C.

    sonotwin project skin=result/surface/surface.ply masses=result/masses/scan calibration=result/drift/optics.yaml out=light
    sonotwin project skin=now.ply earlier_skin=before.ply masses=masses calibration=optics.yaml eye_mm=[0,300,100] out=light
    sonotwin project skin=now.ply masses=masses calibration=optics.yaml out=light show=true devices=basler
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from rich.console import Console

from recon.capture import calibration_files, sweep_part
from recon.devices.interfaces import Projector
from recon.errors import Implausible, InputError
from recon.files import atomic, meshes, metrics
from recon.files.metrics import Metrics
from recon.freehand import scans as freehand_scans
from recon.fusion import fused_scene, probe_shape
from recon.fusion import skin as skin_parts
from recon.fusion.palette import IN_SPACE
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.rig import NotNegative, Part, Rig, Vector
from recon.model.tracks import LagSeconds
from recon.registry import Choice
from recon.segmentation import containment, mass_files
from recon.skin_projection import (
    curve_files,
    mass_outline,
    outline_names,
    planned_cut,
    projector_image,
    scan_line,
    skin_registration,
)
from recon.skin_projection.projector_image import Drawing, Lines, lit_share
from recon.skin_projection.skin_curve import SkinCurve
from recon.skin_projection.skin_registration import SkinShift
from sonotwin.console_watch import LineConsole
from sonotwin.open_devices import LiveDevices, of_a_laboratory, open_projector

PICTURE, CURVES, STRIPS, SCENE, EXPECTED = "projector.png", "curves.json", "curves.ply", "scene.glb", "expected_cam1.png"
LIGHT = (60, 220, 120, 255)  # colour of curves in scene.glb
UNSURE_MM = 0.5  # of a moved mass, beyond which a warning is due
RESHAPED_MM = 0.5  # of a moved skin's distances that are left, the same
LOOK_S = 1.0  # between looks at whether the picture is still on its display


class Config(Part):
    """Fields of `sonotwin project`."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the projector's gamma, and the target's design, by which the probe is masked"""
    skin: Path
    """the skin as it lies now, a .ply as of `sonotwin surface`"""
    calibration: Path
    """file: the projector, and camera 1 for the picture of what it should see"""
    out: Path
    """folder; gets projector.png, curves.json, curves.ply, scene.glb, expected_cam1.png, metrics.json"""
    masses: Path | None = None
    """folder of `sonotwin segment`"""
    cut: Path | None = None
    """a planned cut: curves or lines drawn in 3D Slicer, .mrk.json"""
    eye_mm: Vector | None = None
    """[x, y, z] mm in the world: where the surgeon looks from; null draws along the skin's normal over each"""
    earlier_skin: Path | None = None
    """the skin when masses and cut were found, a .ply: they are moved along with it to `skin`"""
    part_table: bool = True
    """part the skins from the plane that they stand on; a table would hold still where the body moves"""
    capture: Path | None = None
    """a capture folder with a sweep that has poses: one of its B-scans gets its line, and its probe no light"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the volume"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them"""
    scan: Annotated[int, Field(ge=0)] = 0
    """number of the B-scan, from 0"""
    probe: Path | None = None
    """file: the probe's calibration, in place of the capture's own"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""
    margin_mm: NotNegative = projector_image.MARGIN_MM
    """mm around the probe and its target that stay dark, too"""
    names_mm: Annotated[float, Field(ge=0, le=50)] = 5.0
    """mm, height of the letters by which each mass is named beside its outline; 0 draws none"""
    lines: Lines = Lines()
    """on the skin: width in mm, share of the projector's full light, [drawn, left out] in mm or null"""
    show: bool = False
    """have the projector among the devices show projector.png until Ctrl-C, once it is written"""
    devices: Annotated[LiveDevices | None, Choice(None)] = None
    """to show the picture: basler, of which only the projector is opened; copy it for those of a laboratory"""

    @field_validator("devices", mode="before")
    @classmethod
    def _no_stand_ins(cls, given: Any) -> Any:
        return of_a_laboratory(given, "without a projector leave devices and show out, and look at expected_cam1.png")

    @model_validator(mode="after")
    def _shown_by_a_projector(self) -> "Config":
        if self.show and (self.devices is None or self.devices.projector is None):
            found = "no devices" if self.devices is None else "none among the devices"
            raise ValueError(f"show: expected a projector, found {found}; give devices=basler, or a copy of it: see conf/devices")
        return self


class Held(NamedTuple):
    """The probe where it was held."""

    line: SkinCurve  # of its B-scan
    body: trimesh.Trimesh  # in the world


def run(config: Config) -> None:
    """Read what is given, draw, and write; show the picture if it is to be.

    Raises
    ------
    InputError
        If nothing is given to draw, a file is missing or damaged, or nothing of it can be lit; or `out` can't be written to.
    DeviceError
        If the picture is to be shown and the projector's display isn't there, or goes.
    """
    console = LineConsole()
    with opened(config) as projector:
        image = draw(config, console)
        if projector is not None:
            console.print("shown       projector.png, until Ctrl-C")
            keep_shown(projector, image)


def draw(config: Config, console: Console) -> NDArray[np.uint8]:
    """Read what is given, draw, and write; returns the picture : (h, w)."""
    given = (config.skin, config.calibration, config.masses, config.cut, config.earlier_skin, config.capture, config.probe)
    atomic.check_folder(config.out, "project", inputs=given)
    if config.masses is None and config.cut is None and config.capture is None:
        raise InputError("project: expected masses, a cut or a capture to draw, found none of them")
    cameras = calibration_files.read(config.calibration).cameras
    if "projector" not in cameras:
        raise InputError(f"{config.calibration}: expected the projector, found {', '.join(cameras)}")

    with console.status("reading"):
        masses_before = read_masses(config)  # before the skin, which takes seconds
        chains = [] if config.cut is None else planned_cut.read(config.cut)
        skin, shift = read_skin(config.skin, config.part_table), None
        if config.earlier_skin is not None:
            shift = skin_registration.register(read_skin(config.earlier_skin, config.part_table), skin)
        new_from_old = np.eye(4) if shift is None else shift.new_from_old
        masses = {name: mass.copy().apply_transform(new_from_old) for name, mass in masses_before.items()}
        cuts = [rigid.apply(new_from_old, chain) for chain in chains]
        held = None if config.capture is None else read_probe(config, skin)

    start = time.perf_counter()
    curves = [*mass_outline.outlines(masses, skin, config.eye_mm).values()]
    curves += [planned_cut.on_skin(f"cut{k}", chain, skin, config.eye_mm) for k, chain in enumerate(cuts)]
    curves += [] if held is None else [held.line]
    if not curves:
        raise InputError(f"{config.masses}: expected masses to draw, found none in it; give a cut or a capture, too")
    dark = None if held is None else projector_image.probe_shadow(held.body, cameras["projector"], config.margin_mm)
    names = named(config, curves, masses, skin, cameras["projector"], dark)
    drawing = projector_image.draw([*curves, *names], skin, cameras["projector"], config.rig.projector.gamma, config.lines, dark)
    seconds = round(time.perf_counter() - start, 3)
    if not drawing.image.any():
        found = "none: is the calibration that of this rig, and the probe not before all of it?"
        raise InputError(f"{config.skin}: expected some of the curves in the projector's reach, found {found}")

    figures = measure(curves, drawing, masses, shift) | {"seconds_drawing": seconds}
    with console.status("writing"), atomic.new_folder(config.out, "project") as folder:
        written = write(folder, curves, names, drawing, skin, masses, cameras, config.lines)
        metrics.write(folder / metrics.FILE, figures)
    for line in described(curves, drawing, masses, shift):
        console.print(line, markup=False)
    for name in unnamed(config, curves, names):
        console.print(f"warning     no room for the name of {name} on the skin: give a smaller names_mm", markup=False)
    console.print(f"wrote       {config.out}/{{{','.join([*written, metrics.FILE])}}}", markup=False)
    return drawing.image


@contextmanager
def opened(config: Config) -> Iterator[Projector | None]:
    """The projector, dark, if the picture is to be shown."""
    if not config.show:
        yield None
        return
    assert config.devices is not None and config.devices.projector is not None  # as checked by the fields
    chosen = config.devices.projector
    calibration_files.read_for(config.calibration, {"projector": chosen.size})
    with closing(open_projector(chosen)) as projector:
        yield projector


def keep_shown(projector: Projector, image: NDArray[np.uint8]) -> NoReturn:
    """Show the picture until interrupted; DeviceError once the display is gone or changed."""
    while True:
        projector.show(image)
        time.sleep(LOOK_S)


def read_skin(path: Path, part_table: bool) -> trimesh.Trimesh:
    """A skin, parted from the plane that it stands on; raises InputError if it is missing or damaged."""
    whole = containment.read_skin(path)
    return (skin_parts.by_plane(whole).skin or whole) if part_table else whole


def read_masses(config: Config) -> dict[str, trimesh.Trimesh]:
    """The masses by name; there may be none."""
    return {} if config.masses is None else {name: mass.mesh for name, mass in mass_files.read_masses(config.masses).items()}


def read_probe(config: Config, skin: trimesh.Trimesh) -> Held:
    """The probe as it was held for a B-scan of the capture, and the B-scan's line.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, there is no such B-scan, or it has no pose.
    """
    assert config.capture is not None
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume", config.implausible)
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    scans = freehand_scans.of_sweep(sweep, probe, config.lag_s, None)
    count = len(scans.world_from_pixel)
    if config.scan >= count:
        raise InputError(f"project: scan: expected a B-scan of {config.capture}, 0 to {count - 1}, found {config.scan}")
    matrix, width = scans.world_from_pixel[config.scan], scans.shape[1]
    if not np.isfinite(matrix).all():
        raise InputError(f"project: scan: expected a B-scan with a pose, found none of {config.scan}; give another")
    body, _ = probe_shape.of(config.rig.target, probe, width)
    line = scan_line.on_skin(f"scan{config.scan:04d}", matrix, width, skin)
    return Held(line, body.apply_transform(sweep.poses(config.lag_s)[config.scan]))


def named(
    config: Config,
    curves: Sequence[SkinCurve],
    masses: Mapping[str, trimesh.Trimesh],
    skin: trimesh.Trimesh,
    projector: Camera,
    dark: NDArray[np.bool_] | None,
) -> list[SkinCurve]:
    """The masses' names beside their outlines, where there is room for them."""

    def reached(name: SkinCurve) -> bool:
        return lit_share(name, projector_image.in_sight([name], skin, projector, dark)) == 1

    return outline_names.beside(curves, masses, skin, config.eye_mm, config.names_mm, reached) if config.names_mm else []


def unnamed(config: Config, curves: Sequence[SkinCurve], names: Sequence[SkinCurve]) -> list[str]:
    """Masses whose outlines are drawn without their names, though names are wanted."""
    if config.names_mm == 0:
        return []
    shown = {name.name for name in names}
    return [curve.name for curve in curves if curve.kind == "mass" and outline_names.title(curve.name) not in shown]


def measure(
    curves: Sequence[SkinCurve], drawing: Drawing, masses: Mapping[str, trimesh.Trimesh], shift: SkinShift | None
) -> Metrics:
    """Figures of the curves, and of the skin's motion if there was one."""
    found: Metrics = {"curves": len(curves)}
    for curve in curves:
        found |= {
            f"{curve.name}_length_mm": curve.length_mm,
            f"{curve.name}_on_skin": curve.on_skin,
            f"{curve.name}_lit": lit_share(curve, drawing.lit),
        }
    if shift is not None:
        turn = rigid.difference(np.eye(4), shift.new_from_old)[:3]
        found |= {"shift_turn_deg": float(np.rad2deg(np.linalg.norm(turn))), "shift_residual_mm": shift.rms_mm}
        found |= {f"{name}_{key}": value for name, mass in masses.items() for key, value in moved_by(shift, mass).items()}
    return found


def moved_by(shift: SkinShift, mass: trimesh.Trimesh) -> Metrics:
    """Way of a mass that was moved, and the standard deviation of its place by that."""
    before = rigid.apply(rigid.invert(shift.new_from_old), mass.center_mass)
    return {"moved_mm": float(np.linalg.norm(mass.center_mass - before)), "moved_sigma_mm": shift.sigma_mm(before)}


def described(
    curves: Sequence[SkinCurve], drawing: Drawing, masses: Mapping[str, trimesh.Trimesh], shift: SkinShift | None
) -> Iterator[str]:
    """Lines for the console."""
    if shift is not None:
        yield f"shift       {shift.share:.0%} of the earlier skin found again, {shift.rms_mm:.3f} mm off its place"
        if shift.rms_mm > RESHAPED_MM:
            yield "warning     the skin has changed its shape, too: find the masses anew"
        for name, mass in masses.items():
            way = moved_by(shift, mass)
            yield f"{name:12}moved by {way['moved_mm']:.2f} mm, known to {way['moved_sigma_mm']:.2f} mm"
            if way["moved_sigma_mm"] > UNSURE_MM:
                yield f"warning     the skin may slide in itself: {name} is uncertain by it; measure more of the skin"
    for curve in curves:
        lit = lit_share(curve, drawing.lit)
        yield f"{curve.name:12}{curve.length_mm:.1f} mm long on the skin, {lit:.0%} of it lit"
        if curve.on_skin < 1:
            yield f"warning     {1 - curve.on_skin:.0%} of {curve.name} is left out: there is no skin measured"


def write(
    folder: Path,
    curves: Sequence[SkinCurve],
    names: Sequence[SkinCurve],
    drawing: Drawing,
    skin: trimesh.Trimesh,
    masses: Mapping[str, trimesh.Trimesh],
    cameras: Mapping[str, Camera],
    lines: Lines,
) -> list[str]:
    """Write all files but the figures; returns their names."""
    pictures = {PICTURE: drawing.image}
    if "cam1" in cameras:
        pictures[EXPECTED] = projector_image.expected_view([*curves, *names], drawing.lit, skin, cameras["cam1"], lines)
    for name, image in pictures.items():
        (folder / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())
    curve_files.write_json(folder / CURVES, curves)
    curve_files.write_ply(folder / STRIPS, curves, lines)
    shown = {"skin": fused_scene.surface_layer(skin, IN_SPACE.skin, fused_scene.GREY_SKIN)}
    shown |= {name: meshes.painted(mass, IN_SPACE.mass) for name, mass in masses.items()}
    strips = curve_files.strips([*curves, *names], lines)
    shown |= {f"{name}_light": meshes.painted(strip, LIGHT) for name, strip in strips.items()}
    meshes.write_layers(folder / SCENE, shown)
    return [*pictures, CURVES, STRIPS, SCENE]
