"""Masses, or a tube, in B-scans: the settings of the step, the step, and the files of its result."""

from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import cv2
import trimesh
from pydantic import Field, model_validator

from recon.errors import InputError
from recon.files import atomic, meshes, metrics
from recon.files.metrics import Metrics
from recon.freehand import plus_config
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans, ScansFields
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.probe import SCANNER_SPEED, Speed, SpeedSigma
from recon.model.rig import Positive
from recon.segmentation import containment, detectability, left_out, mass_network, seen_map, segmented_scans
from recon.segmentation.mass_network import Looks
from recon.segmentation.seen_map import Seen
from recon.segmentation.segmented_scans import Segmented
from recon.segmentation.tube_wall import Appearance
from recon.session import volume_step
from recon.session.settings import EchoFields, SoughtFields
from recon.session.watch import SILENT, Watch

BY = "segment"  # who writes


class Method(EchoFields):
    """What is looked for in the B-scans, and its appearance."""

    kind: Literal["masses", "tube"] = "masses"
    """what is looked for: masses, which differ from the tissue around them; tube, round, in water"""
    mass_m_s: Speed = SCANNER_SPEED
    """m/s in the masses: 1510 to 1570 in those of the breast"""
    mass_sigma_m_s: SpeedSigma = 20.0
    """m/s, standard deviation of the former, of which their volumes are uncertain"""
    looks: Literal["auto", "always", "never"] = "auto"
    """whether masses are told from tissue by a network, by their looks; auto: where the tissue is as uneven as a breast"""
    network: Path | None = None
    """masses.onnx of `sonotwin train network=masses`; null is the one that comes with the software"""
    dynamic_range_db: Annotated[float, Field(ge=20, le=120)] = 60.0
    """dB from black to white, as set on the scanner"""
    diameter_mm: tuple[Positive, Positive] = (5.0, 36.0)
    """mm, least and most, of a tube"""
    min_contrast_db: Annotated[float, Field(ge=0, le=120)] = 15.0
    """dB, of a tube's wall above the water"""
    top_mm: Annotated[float, Field(ge=0, le=100)] = 2.5
    """mm of ringing at the probe's face, left out when a tube is looked for"""
    overlays: Annotated[int, Field(ge=0, le=100)] = segmented_scans.OVERLAYS
    """B-scans that are drawn with the outline"""

    @model_validator(mode="after")
    def _in_order(self) -> "Method":
        if self.diameter_mm[0] >= self.diameter_mm[1]:
            raise ValueError(f"diameter_mm: expected the least before the most, found {list(self.diameter_mm)}")
        return self

    @property
    def tube(self) -> Appearance:
        """Appearance of a tube."""
        return Appearance(self.diameter_mm, self.spread_mm, self.dynamic_range_db, self.min_contrast_db, self.top_mm)


class Settings(Method, SoughtFields, ScansFields):
    """Sources, and settings of the method."""

    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is the
    configuration's, or else all of it"""
    surface: Path | None = None
    """the skin, as of `sonotwin surface`, a .ply: says whether each mass lies inside, and how deep; with kind=tube the round
    body about the tube, of which diameter and wall are measured"""


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Read, segment and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, there is no tube where one is looked for, or `out` can't be written to.
    """
    sources = (settings.capture, settings.probe, settings.sequence, settings.tracker, settings.config, settings.surface)
    atomic.check_folder(out, BY, inputs=sources)
    skin = None if settings.surface is None else containment.read_skin(settings.surface)
    scans = freehand_scans.in_memory(read(settings))  # what follows reads them some times more
    source = str(settings.capture or settings.sequence)
    freehand_scans.check_size(scans, source, None, settings.implausible)
    for line in volume_step.describe_source(scans, settings):
        watch.say(line)
    for line in freehand_scans.cautions(scans):
        watch.say(f"warning     {line}")
    start = perf_counter()
    found = find(scans, settings, skin, settings.unsure.tissue_m_s, source, watch)
    mapped = map_seen(found, settings, skin, watch)
    figures: Metrics = {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
        "poses_left_out": scans.left_out,
        "speed_m_per_s": scans.speed_m_s,
    }
    with watch.busy("writing"), atomic.new_folder(out, BY) as folder:
        for name, mesh in found.meshes.items():
            meshes.write_ply(folder / f"{name}.ply", mesh)
            meshes.write_glb(folder / f"{name}.glb", mesh)
        if settings.kind == "masses":
            left_out.write(folder / left_out.FILE, found.left_out)
        if mapped is not None:
            seen_map.write(folder, mapped)
            figures |= mapped.figures
        for number, image in enumerate(found.overlays):
            (folder / f"overlay{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
        metrics.write(folder / metrics.FILE, figures | found.figures | {"seconds_segment": round(perf_counter() - start, 3)})
        written = sorted(path.name for path in folder.iterdir())
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")


def find(
    scans: Scans,
    settings: Method | None = None,
    skin: trimesh.Trimesh | None = None,
    tissue_sigma_m_s: float = 0.0,
    source: str = "",
    watch: Watch = SILENT,
) -> Segmented:
    """Find masses, or a tube, in B-scans.

    Parameters
    ----------
    skin : as measured by light; says whether each mass lies inside, and shows the body about a tube
    tissue_sigma_m_s : standard deviation of the speed of sound in the tissue
    source : with which a fault's message starts

    Raises
    ------
    InputError
        If there is no tube where one is looked for, or the B-scans have no poses.
    """
    chosen = settings or Method()
    try:
        with watch.busy(f"looking for {'a tube' if chosen.kind == 'tube' else 'masses'}"):
            if chosen.kind == "tube":
                found = segmented_scans.find_tube(scans, chosen.tube, chosen.overlays, skin)
            else:
                sigmas, sound = (tissue_sigma_m_s, chosen.mass_sigma_m_s), chosen.mass_m_s
                looks = Looks(chosen.looks, None if chosen.network is None else mass_network.opened(chosen.network))
                found = segmented_scans.find_masses(
                    scans, skin, sound, chosen.dynamic_range_db, chosen.overlays, sigmas, chosen.blur, looks
                )
    except InputError as error:
        raise error if str(error).startswith(source) else InputError(f"{source}: {error}") from None
    for line in found.lines:
        watch.say(line)
    return found


def map_seen(found: Segmented, settings: Settings, skin: trimesh.Trimesh | None = None, watch: Watch = SILENT) -> Seen | None:
    """Map what was seen in the B-scans in which masses were sought; None where none were."""
    if found.scans is None:
        return None
    uneven_db = found.figures.get("tissue_uneven_db", detectability.OBSERVER.even_db)
    with watch.busy("mapping what was seen"):
        looks = Looks(settings.looks)
        mapped = seen_map.of_scans(
            found.scans, skin, settings.spreads, settings.sought, uneven_db, settings.dynamic_range_db, looks
        )
    watch.say(mapped.line)
    return mapped


def read(settings: Settings) -> Scans:
    """The B-scans in the world, or in a sequence's reference frame; the parts of them within the clip."""
    plus = None if settings.config is None else plus_config.read_config(settings.config)
    by_plus = None if plus is None else plus.volume
    if by_plus is not None and by_plus.fan is not None and settings.clip is None:
        expected = "none, as masses are sought in rectangles; give clip=[u,v,width,height] within it"
        raise InputError(f"{settings.config}: FanAnglesDeg: expected {expected}, found a fan")
    _, scans = volume_step.read(settings, plus)
    given = None if settings.clip is None else Clip(*settings.clip)
    clip = by_plus.clip if given is None and by_plus is not None else given
    return scans if clip is None else freehand_scans.cut(scans, clip)
