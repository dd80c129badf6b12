"""A rendered digital twin of an imaging rig, and the rig's software: the public Python interface.

The names of `__all__` and `__version__` are the interface; `docs/interface.md` documents each with an example. They are imported
on first use, so `import sonotwin` is instant and needs none of the packages. Everything else is internal and may change between
versions.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
    from recon.capture.board_part import read_board
    from recon.capture.calibration_files import read as read_calibration
    from recon.capture.manifest import Device
    from recon.capture.probe_files import read as read_probe
    from recon.capture.stereo_frames import read_film
    from recon.capture.surface_part import read_surface
    from recon.capture.sweep_part import read_sweep
    from recon.capture.writer import write_surface
    from recon.errors import InputError
    from recon.freehand.hole_filling import fill_holes
    from recon.freehand.volume_compounding import principal_grid
    from recon.freehand.volume_compounding import reconstruct as reconstruct_volume
    from recon.geometry.camera import Camera
    from recon.model.calibration import Calibration
    from recon.model.patterns import Patterns
    from recon.model.probe import ProbeCalibration
    from recon.model.rig import Rig
    from recon.model.tracks import Track
    from recon.optical_calibration.joint_calibration import Settings as OpticsSettings
    from recon.optical_calibration.joint_calibration import calibrate as calibrate_optics
    from recon.optical_calibration.sightings import sight as find_board
    from recon.probe_calibration.cross_wire import find as find_crossing
    from recon.probe_calibration.point_calibration import Sightings as Crossings
    from recon.probe_calibration.point_calibration import calibrate as calibrate_probe
    from recon.probe_calibration.sound_in_water import for_tissue as probe_in_tissue
    from recon.segmentation.blur_correction import Blur
    from recon.segmentation.masses import from_scans as find_masses
    from recon.segmentation.refraction import Sound
    from recon.structured_light.decode import decode
    from recon.structured_light.surface_mesh import clean as clean_surface
    from recon.structured_light.surface_mesh import mesh as mesh_surface
    from recon.structured_light.triangulate import triangulate
    from recon.target_calibration.target_bundle import calibrate as calibrate_target
    from recon.tracking.networks import load as load_networks
    from recon.tracking.tracker import Tracker
    from scenes.catalogue import build_scene
    from sonotwin.choices import read_patterns, read_rig
    from twin.optics.light_transport import Tracing
    from twin.optics.surface_session import Shooting
    from twin.optics.surface_session import shoot as render

__all__ = [
    "AsymmetricCircles",
    "Blur",
    "Calibration",
    "Camera",
    "Crossings",
    "Device",
    "InputError",
    "OpticsSettings",
    "Patterns",
    "ProbeCalibration",
    "Rig",
    "Shooting",
    "Sound",
    "Tracing",
    "Track",
    "Tracker",
    "build_scene",
    "calibrate_optics",
    "calibrate_probe",
    "calibrate_target",
    "clean_surface",
    "decode",
    "fill_holes",
    "find_board",
    "find_crossing",
    "find_masses",
    "load_networks",
    "mesh_surface",
    "principal_grid",
    "probe_in_tissue",
    "read_board",
    "read_calibration",
    "read_film",
    "read_patterns",
    "read_probe",
    "read_rig",
    "read_surface",
    "read_sweep",
    "reconstruct_volume",
    "render",
    "triangulate",
    "write_surface",
]

PLACES = {  # of the public names: module, and name in it where that differs
    "AsymmetricCircles": "recon.board_detection.kinds.asymmetric_circles",
    "Blur": "recon.segmentation.blur_correction",
    "Calibration": "recon.model.calibration",
    "Camera": "recon.geometry.camera",
    "Crossings": "recon.probe_calibration.point_calibration:Sightings",
    "Device": "recon.capture.manifest",
    "InputError": "recon.errors",
    "OpticsSettings": "recon.optical_calibration.joint_calibration:Settings",
    "Patterns": "recon.model.patterns",
    "ProbeCalibration": "recon.model.probe",
    "Rig": "recon.model.rig",
    "Shooting": "twin.optics.surface_session",
    "Sound": "recon.segmentation.refraction",
    "Tracing": "twin.optics.light_transport",
    "Track": "recon.model.tracks",
    "Tracker": "recon.tracking.tracker",
    "build_scene": "scenes.catalogue",
    "calibrate_optics": "recon.optical_calibration.joint_calibration:calibrate",
    "calibrate_probe": "recon.probe_calibration.point_calibration:calibrate",
    "calibrate_target": "recon.target_calibration.target_bundle:calibrate",
    "clean_surface": "recon.structured_light.surface_mesh:clean",
    "decode": "recon.structured_light.decode",
    "fill_holes": "recon.freehand.hole_filling",
    "find_board": "recon.optical_calibration.sightings:sight",
    "find_crossing": "recon.probe_calibration.cross_wire:find",
    "find_masses": "recon.segmentation.masses:from_scans",
    "load_networks": "recon.tracking.networks:load",
    "mesh_surface": "recon.structured_light.surface_mesh:mesh",
    "principal_grid": "recon.freehand.volume_compounding",
    "probe_in_tissue": "recon.probe_calibration.sound_in_water:for_tissue",
    "read_board": "recon.capture.board_part",
    "read_calibration": "recon.capture.calibration_files:read",
    "read_film": "recon.capture.stereo_frames",
    "read_patterns": "sonotwin.choices",
    "read_probe": "recon.capture.probe_files:read",
    "read_rig": "sonotwin.choices",
    "read_surface": "recon.capture.surface_part",
    "read_sweep": "recon.capture.sweep_part",
    "reconstruct_volume": "recon.freehand.volume_compounding:reconstruct",
    "render": "twin.optics.surface_session:shoot",
    "triangulate": "recon.structured_light.triangulate",
    "write_surface": "recon.capture.writer",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version(__name__)
        except PackageNotFoundError:
            raise AttributeError(f"module {__name__!r} isn't installed: it has no version") from None
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, there = PLACES[name].partition(":")
    value = getattr(import_module(module), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__, "__version__"})
