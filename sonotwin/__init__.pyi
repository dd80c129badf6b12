"""The public names of sonotwin, where they stand; `__init__.py` imports each on first use from here."""

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles as AsymmetricCircles
from recon.capture.board_part import read_board as read_board
from recon.capture.calibration_files import read as read_calibration
from recon.capture.manifest import Device as Device
from recon.capture.probe_files import read as read_probe
from recon.capture.stereo_frames import read_film as read_film
from recon.capture.surface_part import read_surface as read_surface
from recon.capture.sweep_part import read_sweep as read_sweep
from recon.capture.writer import write_surface as write_surface
from recon.errors import InputError as InputError
from recon.freehand.hole_filling import fill_holes as fill_holes
from recon.freehand.volume_compounding import principal_grid as principal_grid
from recon.freehand.volume_compounding import reconstruct as reconstruct_volume
from recon.geometry.camera import Camera as Camera
from recon.model.calibration import Calibration as Calibration
from recon.model.patterns import Patterns as Patterns
from recon.model.probe import ProbeCalibration as ProbeCalibration
from recon.model.rig import Rig as Rig
from recon.model.tracks import Track as Track
from recon.optical_calibration.joint_calibration import Settings as OpticsSettings
from recon.optical_calibration.joint_calibration import calibrate as calibrate_optics
from recon.optical_calibration.sightings import sight as find_board
from recon.probe_calibration.cross_wire import find as find_crossing
from recon.probe_calibration.point_calibration import Sightings as Crossings
from recon.probe_calibration.point_calibration import calibrate as calibrate_probe
from recon.probe_calibration.sound_in_water import for_tissue as probe_in_tissue
from recon.segmentation.blur_correction import Blur as Blur
from recon.segmentation.masses import from_scans as find_masses
from recon.segmentation.refraction import Sound as Sound
from recon.structured_light.decode import decode as decode
from recon.structured_light.surface_mesh import clean as clean_surface
from recon.structured_light.surface_mesh import mesh as mesh_surface
from recon.structured_light.triangulate import triangulate as triangulate
from recon.target_calibration.target_bundle import calibrate as calibrate_target
from recon.tracking.networks import load as load_networks
from recon.tracking.tracker import Tracker as Tracker
from scenes.catalogue import build_scene as build_scene
from sonotwin.choices import read_patterns as read_patterns
from sonotwin.choices import read_rig as read_rig
from twin.optics.light_transport import Tracing as Tracing
from twin.optics.surface_session import Shooting as Shooting
from twin.optics.surface_session import shoot as render

__version__: str
