"""Every reader of files that may come from strangers, as a function of one file, with valid files to begin from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from recon.capture import (
    calibration_files,
    images,
    lag_files,
    manifest,
    meza2021_sweep,
    probe_files,
    sweep_tables,
    target_files,
    tip_files,
)
from recon.capture.surface_part import read_patterns
from recon.clips import pose_tables
from recon.clips.dialects import dicom_clip, video_clip
from recon.clips.pose_tables import Columns
from recon.devices.openigtlink.igtl_stream import Splitter
from recon.dicom import enhanced_volume, mass_segments, measurement_report, patient_fields, surface_segments
from recon.dicom.enhanced_volume import ReceivedVolume
from recon.dicom.study_objects import Study
from recon.errors import InputError
from recon.files import meshes, metrics, npz, volumes
from recon.freehand import plus_config, sequences
from recon.geometry import rigid
from recon.model.rig import Target
from recon.probe_calibration import plus_phantom
from recon.rig_check import check_log
from recon.segmentation import mass_network
from recon.skin_projection import planned_cut
from recon.tracking import networks
from sonotwin import config
from tests.recon.dicom import made_results
from trainers import export, markerpose_layout, scan_reader, shard_reader
from twin import session


@dataclass(frozen=True)
class Reader:
    """A reader."""

    read: Callable[[Path], object]
    seeds: tuple[str, ...]  # valid files among the sources
    name: str = "file"  # that the file has, where it matters


def _design() -> Target:
    from sonotwin.verbs import track

    return config.load("track", ["capture=none", "out=none"], track.Config).rig.target


def _manifest(path: Path) -> object:
    return manifest.read_manifest(path.parent)


def _shard(path: Path) -> object:
    return shard_reader.read_views([path.parent])


def _outlines(path: Path) -> object:
    return scan_reader.read_scans([path.parent])


def _sequence(path: Path) -> object:
    return sequences.read_tracking(path), sum(1 for _ in sequences.stream_images(path))


def _segments(path: Path) -> object:
    """Segments over the volume that the sources have beside them."""
    given, patient = made_results.results(), made_results.SUPINE
    volume, turn = given.moved(patient.patient_from_world).volume, patient.patient_from_world
    frame = Study.of(patient, given).uid("frame of reference")
    return mass_segments.read(path, ReceivedVolume(volume, frame, rigid.invert(turn)))


def _messages(path: Path) -> object:
    """Messages of a stream, whose checksums would keep most faults from what reads them."""
    found = [one for one, _ in Splitter(check=False).feed(path.read_bytes())]
    for fault in [one for one in found if isinstance(one, InputError)]:
        raise fault
    return found


COLUMNS = Columns(time="t", translation=("x", "y", "z"), quaternion=("qx", "qy", "qz", "qw"))
POINTS = {"points": npz.Form("f", (None, 3)), "pixels": npz.Form("f", (None, 2))}

READERS = {
    "manifest": Reader(_manifest, ("ball/capture/manifest.json", "board/capture/manifest.json", "scan/capture/manifest.json"),
                       "manifest.json"),
    "calibration": Reader(calibration_files.read, ("optics/optics.yaml", "ball/capture/calibration/optics.yaml")),
    "calibration_xml": Reader(calibration_files.read, ("optics/StereoParams.xml",), "file.xml"),
    "calibration_npz": Reader(calibration_files.read, ("optics/cam1_proj_params.npz", "optics/cam1_cam2_params.npz"), "file.npz"),
    "kalibr": Reader(calibration_files.read, ("for_kalibr/camchain.yaml",)),
    "ros": Reader(calibration_files.read, ("for_ros/cam1.yaml",)),
    "mrcal": Reader(calibration_files.read, ("for_mrcal/cam2.cameramodel",)),
    "slstudio": Reader(calibration_files.read, ("for_slstudio/calibration.xml",), "file.xml"),
    "probe": Reader(probe_files.read, ("probe/probe.yaml",)),
    "target": Reader(lambda path: target_files.read(path, DESIGN), ("target/target.yaml",)),
    "tip": Reader(tip_files.read, ("small_tip.yaml",)),
    "lag": Reader(lag_files.read, ("lag/lag.json",), "lag.json"),
    "stamps": Reader(sweep_tables.read_stamps, ("scan/capture/sweep/us/timestamps.csv",)),
    "track": Reader(sweep_tables.read_track, ("scan/capture/sweep/track.csv",)),
    "authors_poses": Reader(lambda path: meza2021_sweep.read_rows(path, (4, 4)), ("sets/data1/target_pose.npy",), "file.npy"),
    "pairs": Reader(sweep_tables.read_pairs, ("pairs.csv",)),
    "pose_table": Reader(lambda path: pose_tables.read(path, COLUMNS), ("poses.csv",)),
    "image": Reader(lambda path: images.read_image(path, (321, 408), 8), ("scan/capture/sweep/us/0003.png",)),
    "mesh": Reader(lambda path: meshes.read_ply(path, "a mesh"), ("small.ply",), "file.ply"),
    "model_stl": Reader(lambda path: meshes.read_model(path, "a model"), ("needle.stl",), "file.stl"),
    "model_glb": Reader(lambda path: meshes.read_model(path, "a model"), ("needle.glb",), "file.glb"),
    "volume_nrrd": Reader(volumes.read_volume, ("small.nrrd",), "file.nrrd"),
    "volume_mha": Reader(volumes.read_volume, ("small.mha",), "file.mha"),
    "sequence": Reader(_sequence, ("small.igs.mha",), "file.igs.mha"),
    "plus_config": Reader(plus_config.read_config, ("plus.xml",)),
    "plus_phantom": Reader(lambda path: plus_phantom.read(path, "Reference"), ("fcal.xml",)),
    "messages": Reader(_messages, ("small.igtl",), "file.igtl"),
    "dicom": Reader(dicom_clip.read, ("scan.dcm",), "file.dcm"),
    "archived_volume": Reader(enhanced_volume.read, ("archived/volume.dcm",), "file.dcm"),
    "archived_masses": Reader(_segments, ("archived/masses.dcm",), "file.dcm"),
    "archived_surfaces": Reader(surface_segments.read, ("archived/surfaces.dcm",), "file.dcm"),
    "archived_report": Reader(measurement_report.read, ("archived/report.dcm",), "file.dcm"),
    "patient": Reader(patient_fields.read, ("patient.yaml",), "file.yaml"),
    "video": Reader(video_clip.read, ("screen.avi",), "file.avi"),
    "patterns": Reader(read_patterns, ("patterns.yaml",), "file.yaml"),
    "metrics": Reader(metrics.read, ("skin/metrics.json",)),
    "truth": Reader(session.read_json, ("ball/truth/scene.json",)),
    "check_log": Reader(check_log.read, ("rig.jsonl",)),
    "cut": Reader(planned_cut.read, ("cut.mrk.json",)),
    "points": Reader(lambda path: npz.read(path, POINTS), ("small.npz",)),
    "shard": Reader(_shard, ("data/shard-00000.tar",), "shard-00000.tar"),
    "centres": Reader(markerpose_layout.read_table, ("markerpose/data_centers.csv",), "data_centers.csv"),
    "outlines": Reader(_outlines, ("outlined/outlines.csv",), "outlines.csv"),
    "checkpoint": Reader(export.read_state, ("small.pt",)),
    "network": Reader(lambda path: networks.session(path, networks.SEGMENTER), ("networks/segmenter.onnx",), "file.onnx"),
    "mass_network": Reader(mass_network.opened, ("masses.onnx",), "file.onnx"),
}  # fmt: skip
DESIGN = _design()
