"""Valid inputs, small ones, made by the commands themselves, and the commands that read them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from campaign import commands
from campaign.commands import Run
from recon.capture import probe_files, surface_part, sweep_part, sweep_tables, tip_files
from recon.devices.openigtlink import igtl_messages
from recon.files import atomic
from recon.geometry import rigid
from recon.model.tip import Tip
from tests.recon.clips import made_clips
from tests.recon.devices.openigtlink import igtl_peers
from tests.recon.dicom import made_results
from tests.recon.probe_calibration import test_plus_phantom
from tests.recon.tip_calibration import pivot_films

LONGEST_S = 600.0
STROKE = ("path.start_mm=[-18,-2]", "path.end_mm=[-18,8]", "path.speed_mm_s=20")
MOVING = ("path.rest_s=0", "path.move_s=1.5", "clocks.scanner_hz=6")
MADE = (  # command lines in the order in which they are run
    ("render", "scene=sphere", "cameras=[cam1]", "tracing.samples=4", "out=ball"),
    ("render", "scene=board", "poses=demo", "poses.count=5", "patterns=paper_calibration", "cameras=[cam1,cam2]",
     "tracing.samples=4", "out=board"),
    ("render", "scene=sphere", "cameras=[cam1,cam2]", "tracing.samples=4", "out=both"),
    ("render", "scene=sphere", "scene.background_mm=null", "patterns=gray_surface", "tracing.samples=4", "out=balls/sphere/00"),
    ("sweep", "scene=crosswire", "ultrasound=water", "path=wire", "path.count=12", "out=wires"),
    ("sweep", "scene=n_wires", "ultrasound=water", "path=rows", "path.count=12", "out=rows"),
    ("sweep", "scene=crosswire", "ultrasound=water", "path=wire", "out=wires_in_full"),
    ("sweep", "scene=n_wires", "ultrasound=water", "path=rows", "out=rows_in_full"),
    ("sweep", "scene=plane", "ultrasound=water", "path=tilts", "path.count=20", "out=wall"),
    ("sweep", "scene=sphere", "ultrasound=water", "path=tilts", "path.count=20", "out=sphere"),
    ("sweep", "scene=crosswire", "ultrasound=water", "path=wire", "path.count=9", *MOVING, "path.roll_deg=60", "out=moving"),
    ("sweep", "scene=n_wires", "ultrasound=water", "path=rows", "path.count=9", *MOVING, "path.tilt_deg=15", "path.roll_deg=15",
     "out=moving_rows"),
    ("sweep", "scene=tank", "ultrasound=water", "path=bob", "path.seconds=2", "out=bottom"),
    ("sweep", "scene=gelatin", "path.start_mm=[4,-50]", "path.end_mm=[4,30]", "path.speed_mm_s=40", "clocks.scanner_hz=3",
     "name=tissue", "add=true", "out=phantom"),
    ("sweep", "scene=tank", "path=bob", "path.middle_mm=[4,-2,600]", "path.seconds=0.3", "name=air", "add=true", "out=phantom"),
    ("sweep", *STROKE, "out=scan"),
    ("sweep", "path=raster", "out=raster"),
    ("sweep", "rig=three_bodies", "scene=tank", "ultrasound=water", "path=hold", "path.surface=tank", "path.standoff_mm=40",
     "bodies.needle.path={kind: insertion, rest_s: 5}", "clocks.scanner_hz=2", "out=needle"),
    ("sweep", *STROKE, "filmed=true", "clocks.camera_hz=20", "out=filmed"),
    ("film", "frames=24", "path.turn_deg=20", "white_dn=120", "seed=1", "out=film"),
    ("dataset", "samples=4", "shard=2", "out=data"),
    ("train", "network=detector", "data=data", "steps=2", "batch=2", "crop_px=64", "out=net"),
    ("export", "layout=markerpose", "data=data", "capture=film/capture", "out=markerpose"),
    ("surface", "capture=ball/capture", "out=skin"),
    ("calibrate-optics", "capture=board/capture", "out=optics"),
    ("calibrate-optics", "capture=board/capture", "distortion=decentred", "out=optics_of_four"),
    *(("export", f"layout={layout}", "calibration=optics_of_four/optics.yaml", f"out=for_{layout}")
      for layout in ("kalibr", "ros", "mrcal", "slstudio")),
    ("calibrate-probe", "capture=wires/capture", "out=probe"),
    ("measure-lag", "capture=bottom/capture", "out=lag"),
    ("freehand", "capture=scan/capture", "out=volume"),
    ("segment", "capture=scan/capture", "out=masses"),
    ("calibrate-target", "capture=film/capture", "least_tilt_deg=0", "least_range_mm=0", "out=target"),
    ("export", "capture=ball/capture", "out=published"),
    ("export", "layout=us_calibration", "capture=wires/capture", "out=sets"),
    ("check", "capture=bottom/capture", "lag=lag/lag.json", "log=rig.jsonl", "out=checked"),
    ("study", "name=sweep", "of=tracking", "film.frames=2", "over={film.rays: [16]}", "seeds=1", "out=study"),
)  # fmt: skip


@dataclass(frozen=True)
class Command:
    """A valid command, as it is run in a folder that holds copies of some sources."""

    verb: str
    fields: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()  # sources that it needs
    reads: tuple[str, ...] = ()  # files of those that it must refuse if they are damaged
    reads_in_part: tuple[str, ...] = ()  # files of which some fields or pixels don't matter to it: it must refuse other files
    minutes: bool = False  # that it takes without a fault: it isn't tried without one
    out: str = "new"  # nothing for a verb that writes none

    @property
    def line(self) -> tuple[str, ...]:
        """The whole command line."""
        return (self.verb, *self.fields, *([f"out={self.out}"] if self.out else []))


def _sweep(name: str, number: int = 3) -> tuple[str, ...]:
    part = f"{name}/capture/sweep"
    return f"{name}/capture/manifest.json", f"{part}/track.csv", f"{part}/us/timestamps.csv", f"{part}/us/{number:04d}.png"


def _film(name: str) -> tuple[str, ...]:
    part = f"{name}/capture/sweep"
    images = tuple(f"{part}/cam{k}/{file}" for k in (1, 2) for file in ("timestamps.csv", "0001.png"))
    return f"{name}/capture/manifest.json", *images, f"{name}/capture/calibration/optics.yaml"


BALL = ("ball/capture/manifest.json", "ball/capture/surface/cam1/0003.png", "ball/capture/calibration/optics.yaml")
SCAN = (*_sweep("scan"), "scan/capture/calibration/probe.yaml")
PLAYED = (
    "filmed/capture/manifest.json",
    "filmed/capture/calibration/optics.yaml",
    "filmed/capture/calibration/probe.yaml",
    *(f"filmed/capture/sweep/{device}/timestamps.csv" for device in ("cam1", "cam2", "us")),
)  # images: while it goes on
POSES = ("columns.time=t", "columns.translation=[x,y,z]", "columns.quaternion=[qx,qy,qz,qw]")

COMMANDS = (
    Command("surface", ("capture=ball/capture",), ("ball",), BALL),
    Command("surface", ("images=shots", "patterns=patterns.yaml", "calibration=optics/optics.yaml"),
            ("shots", "patterns.yaml", "optics"), ("shots/0003.png", "patterns.yaml", "optics/optics.yaml")),
    Command("surface", ("images=shots", "patterns=paper_surface", "calibration=optics/cam1_proj_params.npz"),
            ("shots", "optics"), ("optics/cam1_proj_params.npz",)),
    Command("evaluate", ("surface=skin", "truth=ball/truth"), ("skin", "ball"),
            ("skin/points.npz", "ball/truth/calibration/optics.yaml", "ball/truth/surface/cam1.npz"), ("ball/truth/scene.json",)),
    Command("calibrate-optics", ("capture=board/capture",), ("board",),
            ("board/capture/manifest.json", "board/capture/board/01/cam1/0003.png", "board/capture/board/02/cam2/lit.png")),
    Command("calibrate-optics", ("capture=board/capture", "truth=board/truth"), ("board",),
            ("board/truth/calibration/optics.yaml",)),
    Command("calibrate-probe", ("capture=wires/capture", "earlier=probe/probe.yaml"), ("wires", "probe"),
            (*_sweep("wires"), "probe/probe.yaml")),
    Command("calibrate-probe", ("pairs=pairs.csv",), ("pairs.csv",), ("pairs.csv",)),
    Command("calibrate-probe", ("runs=[noisy_pairs.csv,probe]",), ("noisy_pairs.csv", "probe"),
            ("noisy_pairs.csv", "probe/probe.yaml")),
    Command("calibrate-probe", ("capture=rows/capture", "phantom=n_wires", "wires=fcal.xml", "lag_s=0"), ("rows", "fcal.xml"),
            (*_sweep("rows"), "fcal.xml")),
    Command("calibrate-probe", ("capture=wall/capture", "phantom=wall", "max_sigma_mm=5"), ("wall",), _sweep("wall")),
    Command("calibrate-probe", ("capture=sphere/capture", "phantom=sphere", "sphere_radius_mm=19.8", "max_sigma_mm=5"),
            ("sphere",), _sweep("sphere")),
    Command("identify", ("capture=both/capture",), ("both",),
            ("both/capture/manifest.json", "both/capture/surface/cam2/0003.png", "both/capture/calibration/optics.yaml")),
    Command("identify", ("capture=board/capture", "dark=covered"), ("board", "covered"),
            ("board/capture/manifest.json", "board/capture/board/01/cam1/0003.png", "covered/cam1/0003.png")),
    Command("compare-twin", ("capture=ball/capture", "tracing.samples=2"), ("ball",), BALL[:2]),
    Command("identify", ("capture=phantom/capture", "tissue=tissue", "air=air", "attenuation_db_per_cm_mhz=0.5", "echo_db=0"),
            ("phantom",),
            ("phantom/capture/manifest.json", "phantom/capture/sweep/tissue/us/timestamps.csv",
             "phantom/capture/sweep/tissue/us/0003.png", "phantom/capture/sweep/air/us/0001.png",
             "phantom/capture/calibration/probe.yaml")),
    Command("certify", ("capture=balls", "artefacts.bar=null", "artefacts.plane=null", "limits.pf_mm=1", "limits.pf95_mm=1"),
            ("balls",), tuple(f"balls/sphere/00/{name.removeprefix('ball/')}" for name in BALL)),
    Command("certify", ("capture=tool", "artefacts=divots.yaml", "tip=small_tip.yaml"), ("tool", "divots.yaml", "small_tip.yaml"),
            ("tool/divots/01.csv", "divots.yaml", "small_tip.yaml")),
    Command("certify", ("capture=scanner", "artefacts=filaments.yaml"), ("scanner", "filaments.yaml"),
            ("scanner/filaments/00/1.png", "filaments.yaml")),
    Command("score-benchmark", ("results=scored", "truth=sealed"), ("scored", "sealed"),
            ("scored/000000-optics/calibration.yaml", "scored/000001-tracking/poses.csv",
             "sealed/000001-tracking/sweep/film.npz")),
    Command("calibrate-target", ("capture=film/capture", "least_tilt_deg=0", "least_range_mm=0"), ("film",), _film("film")),
    Command("calibrate-tip", ("track=pivot.csv", "model=needle.stl"), ("pivot.csv", "needle.stl"), ("pivot.csv", "needle.stl")),
    Command("compare-tip", ("capture=needle/capture", "body=needle", "tip=needle_tip.yaml", "lag_s=0.05", "beside_mm=1"),
            ("needle", "needle_tip.yaml"),
            (*_sweep("needle"), "needle/capture/calibration/probe.yaml", "needle/capture/sweep/bodies/needle/poses.csv",
             "needle_tip.yaml")),
    Command("measure-lag", ("capture=bottom/capture",), ("bottom",), _sweep("bottom")),
    Command("track", ("capture=film/capture", "target=target/target.yaml", "networks=networks"),
            ("film", "target", "networks"),
            (*_film("film"), "target/target.yaml", "networks/detector.onnx", "networks/segmenter.onnx")),
    Command("check", ("capture=film/capture", "target=target/target.yaml", "alarm_sigma=20"), ("film", "target"),
            (*_film("film"), "target/target.yaml")),
    Command("check", ("capture=both/capture", "alarm_sigma=20"), ("both",),
            ("both/capture/manifest.json", "both/capture/surface/cam2/0003.png", "both/capture/calibration/optics.yaml")),
    Command("correct-optics", ("capture=both/capture",), ("both",),
            ("both/capture/manifest.json", "both/capture/surface/cam2/0003.png", "both/capture/calibration/optics.yaml")),
    Command("check", ("capture=bottom/capture", "probe=probe/probe.yaml", "lag=lag/lag.json", "log=rig.jsonl"),
            ("bottom", "probe", "lag", "rig.jsonl"), (*_sweep("bottom"), "probe/probe.yaml", "lag/lag.json", "rig.jsonl")),
    Command("check", ("today=today", "rig.measured={projector.gamma: {sigma: 0.01, source: sheet}}"), ("today",),
            ("today/rig.yaml",)),
    Command("navigate", ("capture=filmed/capture", "skin=bent.ply", "masses=lump", "seconds=1", "view.port=0",
                         "igtl.serve=false"),
            ("filmed", "bent.ply", "lump"), (*PLAYED, "bent.ply", "lump/mass0.ply"), out=""),
    Command("navigate", ("capture=filmed/capture", "rig=three_bodies", "tips.needle=small_tip.yaml", "reference=pivot.csv",
                         "plan=[[0,0,600],[0,0,700]]", "masses=lump", "seconds=1", "view.port=0", "igtl.serve=false"),
            ("filmed", "small_tip.yaml", "pivot.csv", "lump"), ("small_tip.yaml", "pivot.csv"), out=""),
    Command("mentor", ("capture=filmed/capture", "calibration=optics/optics.yaml", "skin=bent.ply", "masses=lump",
                       "cut=cut.mrk.json", "seconds=1", "view.port=0"),
            ("filmed", "optics", "bent.ply", "lump", "cut.mrk.json"),
            ("filmed/capture/manifest.json", "filmed/capture/sweep/cam1/timestamps.csv", "optics/optics.yaml", "bent.ply",
             "lump/mass0.ply", "cut.mrk.json")),
    Command("project", ("skin=bent.ply", "calibration=optics/optics.yaml", "masses=lump", "cut=cut.mrk.json"),
            ("bent.ply", "optics", "lump", "cut.mrk.json"),
            ("bent.ply", "optics/optics.yaml", "lump/mass0.ply", "cut.mrk.json")),
    Command("project", ("skin=bent.ply", "calibration=optics/optics.yaml", "cut=cut.mrk.json", "capture=scan/capture"),
            ("bent.ply", "optics", "scan", "cut.mrk.json"), SCAN),
    Command("freehand", ("capture=scan/capture",), ("scan",), SCAN),
    Command("freehand", ("sequence=volume/sequence.igs.mha", "config=plus.xml"), ("volume", "plus.xml"),
            ("volume/sequence.igs.mha", "plus.xml")),
    Command("segment", ("capture=scan/capture",), ("scan",), SCAN),
    Command("segment", ("sequence=volume/sequence.igs.mha", "kind=masses"), ("volume",), ("volume/sequence.igs.mha",)),
    Command("segment", ("capture=scan/capture", "network=masses.onnx"), ("scan", "masses.onnx"), ("masses.onnx",)),
    Command("fuse", ("capture=scan/capture", "surface=skin/surface.ply", "volume=volume", "part_table=false"),
            ("scan", "skin", "volume"), (*SCAN, "skin/surface.ply", "volume/volume.nrrd")),
    Command("reconstruct", ("capture=scan/capture", "probe=probe/probe.yaml"), ("scan", "probe"),
            ("probe/probe.yaml",), ("scan/capture/manifest.json",)),
    Command("export", ("capture=ball/capture", "surface=skin"), ("ball", "skin"), (*BALL, "skin/points.npz")),
    Command("export", ("layout=kalibr", "calibration=optics_of_four/optics.yaml"), ("optics_of_four",),
            ("optics_of_four/optics.yaml",)),
    Command("describe", ("folder=shots", "patterns=patterns.yaml", "calibration=for_slstudio/calibration.xml"),
            ("shots", "patterns.yaml", "for_slstudio"), ("for_slstudio/calibration.xml",), ("shots/0003.png",)),
    Command("import", ("folder=published",), ("published",),
            ("published/SLdata/images/3.png",)),
    Command("export", ("layout=us_calibration", "capture=wires/capture"), ("wires",), _sweep("wires")),
    Command("export", ("layout=screen", "capture=scan/capture"), ("scan",), SCAN),
    Command("export", ("layout=dicom", "volume=volume", "masses=lump", "surface=bent.ply", "patient=patient.yaml"),
            ("volume", "lump", "bent.ply", "patient.yaml"),
            ("volume/volume.nrrd", "lump/mass0.ply", "bent.ply"), ("patient.yaml",)),
    Command("import-results", ("folder=archived",), ("archived",), ("archived/volume.dcm",)),  # the others may be missing
    Command("import", ("layout=us_calibration", "folder=sets"), ("sets",),
            ("sets/data1/UScrop/US3.png",)),
    Command("import", ("layout=stereo_basler", "folder=sets/data1"), ("sets",), ("sets/data1/UScrop/US3.png",)),
    Command("import-sweep", ("clip=scan.dcm", "poses=poses.csv", "starts_s=100", *POSES), ("scan.dcm", "poses.csv"),
            ("scan.dcm", "poses.csv")),
    Command("import-sweep", ("clip=screen.avi", "poses=poses.csv", *POSES), ("screen.avi", "poses.csv"), ("screen.avi",)),
    Command("describe", ("folder=shots", "patterns=patterns.yaml", "calibration=optics/optics.yaml"),
            ("shots", "patterns.yaml", "optics"), ("patterns.yaml", "optics/optics.yaml"), ("shots/0003.png",)),
    Command("train", ("network=detector", "data=data", "init=net/detector.safetensors", "steps=2", "batch=2", "crop_px=64"),
            ("data", "net"), ("data/shard-00001.tar", "net/detector.safetensors"), ("data/dataset.json",)),
    Command("train", ("network=detector", "data=data", "init=net/detector.pt", "steps=2", "batch=2", "crop_px=64"),
            ("data", "net"), ("net/detector.pt",)),
    Command("train", ("network=detector", "data=markerpose", "steps=2", "batch=2", "crop_px=64"), ("markerpose",),
            ("markerpose/data_centers.csv", "markerpose/images/im1.png")),
    Command("train", ("network=segmenter", "data=markerpose", "steps=2", "batch=2"), ("markerpose",),
            ("markerpose/patch120/000001.png", "markerpose/mask120/000002.png")),
    Command("train", ("network=masses", "data=scan", "validation_data=outlined", "steps=2", "batch=2"), ("scan", "outlined"),
            (*SCAN, "scan/truth/sweep/labels/0003.png", "outlined/outlines.csv", "outlined/image.png", "outlined/mask.png"),
            ("scan/truth/scene.json",)),
    Command("export", ("layout=markerpose", "data=data", "capture=film/capture"), ("data", "film"),
            ("data/shard-00001.tar", *_film("film"))),
    Command("import", ("layout=markerpose", "folder=markerpose"), ("markerpose",),
            ("markerpose/images/L/3.png", "markerpose/StereoParams.xml")),
    Command("render", ("scene=sphere", "tracing.samples=2")),
    Command("render-artefacts", ("artefacts=upright.yaml", "tracing.samples=2"), ("upright.yaml",), ("upright.yaml",)),
    Command("sweep", STROKE),
    Command("film", ("frames=1",)),
    Command("dataset", ("samples=1",)),
    Command("print", ("part=board",), out="new.pdf"),
    Command("record", ("part=surface", "scene=sphere", "cameras=[cam1]", "tracing.samples=2", "preview.serve=false")),
    Command("patterns", ("patterns=paper_surface",)),
    Command("study", ("name=study.yaml", "of=tracking", "film.frames=1"), ("study.yaml",), ("study.yaml",)),
    Command("demo", ("scene=sphere", "path=none", "poses=none", "board=boards", "film_frames=0")),
    Command("accuracy", ("only=optics",), minutes=True),
)  # fmt: skip


def make(folder: Path, names: Collection[str] | None = None, command: Run = commands.run) -> None:
    """Make some sources, or all and what no command writes, as far as they aren't there; RuntimeError if a command fails."""
    folder.mkdir(parents=True, exist_ok=True)
    for line in MADE:
        if (names is None or _out(line) in names) and not (folder / _out(line)).exists():
            outcome = command(line, folder, LONGEST_S)
            if outcome.status:
                raise RuntimeError(f"sonotwin {' '.join(line)}: {outcome.said}")
    if names is None and not all((folder / name).exists() for name in ("raster.csv", "study.yaml", "fcal.xml")):
        _write_others(folder)


def _out(line: Sequence[str]) -> str:
    return next(field.removeprefix("out=") for field in line if field.startswith("out="))


def _write_others(folder: Path) -> None:
    """Files that no command writes: shots without a manifest, a clip, tables, configurations."""
    import json
    import shutil

    import yaml

    from recon.segmentation import mass_network
    from recon.tracking import networks

    shutil.copytree(folder / "ball/capture/surface/cam1", folder / "shots", dirs_exist_ok=True)
    shutil.copytree(folder / "ball/capture/surface/cam1", folder / "covered/cam1", dirs_exist_ok=True)
    patterns = surface_part.read_surface(folder / "ball/capture").patterns
    (folder / "patterns.yaml").write_text(yaml.safe_dump(json.loads(patterns.model_dump_json())), encoding="utf-8")
    shutil.copytree(networks.WEIGHTS, folder / "networks", dirs_exist_ok=True)
    shutil.copy(mass_network.WEIGHTS, folder / "masses.onnx")
    _write_outlined(folder / "outlined")
    shown = made_clips.screens(made_clips.scans(24))
    made_clips.write_dicom(folder / "scan.dcm", shown, FrameTime=50.0)
    made_clips.write_video(folder / "screen.avi", shown, 20.0)
    _write_poses(
        folder / "poses.csv", [[time, 0, 10 * (time - 99), 650, 0, 0, 0, 1] for time in (99.0 + np.arange(60) / 20).tolist()]
    )
    (folder / "pairs.csv").write_text(_pairs(folder), encoding="utf-8")
    (folder / "noisy_pairs.csv").write_text(_pairs(folder, noise_px=0.3), encoding="utf-8")
    _write_exported(folder)
    (folder / "plus.xml").write_text(PLUS, encoding="utf-8")
    (folder / "fcal.xml").write_text(test_plus_phantom.written(), encoding="utf-8")
    _write_what_is_projected(folder)
    _write_small_ones(folder)
    _write_tool(folder)
    _write_benchmark(folder)
    _write_rig(folder / "today")
    (folder / "study.yaml").write_text("title: Rays\nof: tracking\nover:\n  film.rays: [16]\nseeds: 1\n", encoding="utf-8")


def _write_outlined(folder: Path) -> None:
    """A breast image of others, with the outline of a mass."""
    import cv2

    folder.mkdir(exist_ok=True)
    mask = cv2.circle(np.zeros((160, 200), np.uint8), (90, 70), 30, 255, -1)
    for name, pixels in (("image", np.random.default_rng(0).integers(1, 256, mask.shape, np.uint8)), ("mask", mask)):
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
    (folder / "outlines.csv").write_text("image,mask,mm_per_px\nimage.png,mask.png,0.2\n", encoding="utf-8")


def _write_exported(folder: Path) -> None:
    """The raster as another scanner's clip and another tracker's table."""
    sweep = sweep_part.read_sweep(folder / "raster/capture")
    made_clips.write_dicom(folder / "raster.dcm", np.array(list(sweep.images())), region=False, FrameTime=50.0)
    poses = sweep.track.poses[sweep.track.found]
    seconds = 100 + (sweep.track.times[sweep.track.found] - sweep.times[0]) * 1e-9
    table = np.column_stack([seconds, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    _write_poses(folder / "raster.csv", table.tolist())


def _write_poses(path: Path, table: Sequence[Sequence[float]]) -> None:
    """A table of another tracker's: times in s, places in mm, quaternions."""
    rows = [",".join(f"{number:.9g}" for number in row) for row in table]
    path.write_text("\n".join(["t,x,y,z,qx,qy,qz,qw", *rows]) + "\n", encoding="utf-8")


def _write_what_is_projected(folder: Path) -> None:
    """A skin that is read at once, a mass below it where no probe takes the light, and a cut over that."""
    import json

    import trimesh

    from recon.files import meshes
    from scenes.solid_meshes import grid

    points, triangles = grid((240.0, 200.0), (60, 50))
    height = 660 + ((points / [12.0, 11.0]) ** 2).sum(axis=1)
    skin = trimesh.Trimesh(np.column_stack([points, height]), triangles[:, ::-1], process=False)
    place = np.array([0.0, 50.0, 680.0])
    mass = trimesh.creation.icosphere(2, 4.0).apply_translation(place + np.array([0, 0, 10]))
    (folder / "lump").mkdir(exist_ok=True)
    meshes.write_ply(folder / "lump/mass0.ply", mass)
    meshes.write_ply(folder / "bent.ply", skin)
    cut = [{"position": (place + np.array([aside, 4, 0])).tolist()} for aside in (-6, -2, 2, 6)]
    (folder / "cut.mrk.json").write_text(json.dumps({"markups": [{"type": "Curve", "controlPoints": cut}]}), encoding="utf-8")


def _write_small_ones(folder: Path) -> None:
    """Small files of the kinds that are read whole, to begin fuzzing from."""
    import torch
    import trimesh

    from recon.files import meshes, volumes
    from recon.freehand import sequences

    meshes.write_ply(folder / "small.ply", trimesh.creation.icosphere(1, 10.0))
    voxels = np.random.default_rng(0).integers(0, 256, (4, 5, 6), np.uint8)
    for suffix in (".nrrd", ".mha"):
        volumes.write_volume(folder / f"small{suffix}", volumes.Volume(voxels, np.zeros(3), np.ones(3)))
    probe = probe_files.read(folder / "probe" / "probe.yaml")
    poses = np.tile(np.eye(4), (4, 1, 1))
    sequences.write_sequence(folder / "small.igs.mha", sequences.sequence_of(voxels, poses, probe, np.arange(4.0)))
    np.savez(folder / "small.npz", points=np.zeros((7, 3)), pixels=np.zeros((7, 2)))
    messages = igtl_peers.all_kinds(np.random.default_rng(0))
    (folder / "small.igtl").write_bytes(b"".join(igtl_messages.pack(one, 1 + k % 2) for k, one in enumerate(messages)))
    (folder / "archived").mkdir(exist_ok=True)
    made_results.written(folder / "archived")
    (folder / "patient.yaml").write_text('name: Doe^Jane\ndate: "20261130"\naxes: [left, feet, back]\n', encoding="utf-8")
    torch.save({"weight": torch.zeros(3, 2), "bias": torch.zeros(3)}, folder / "small.pt")


def _write_tool(folder: Path) -> None:
    """Poses of a needle that pivots in a dimple, and in two divots, its mesh, its tip, B-scans of filaments, and certificates."""
    import json

    import cv2
    import trimesh

    rng, length = np.random.default_rng(0), 150.0
    needle = pivot_films.Tool(np.array([0.0, 0.0, -length]), np.array([0.0, 0.0, -1.0]))
    poses = pivot_films.poses_of(pivot_films.turns(needle, rng), needle.tip)
    sweep_tables.write_track(folder / "pivot.csv", pivot_films.tracked(poses, rng))
    (folder / "tool/divots").mkdir(parents=True, exist_ok=True)
    for k, aside_mm in enumerate((0.0, 80.0)):
        moved = rigid.transform(np.eye(3), (aside_mm, 0, 0)) @ poses
        sweep_tables.write_track(folder / f"tool/divots/{k:02d}.csv", pivot_films.tracked(moved, rng))
    (folder / "divots.yaml").write_text("divots: {places_mm: [[0, 0, 0], [80, 0, 0]], expanded_mm: 0.02}\n", encoding="utf-8")
    places = ((2.0, 5.0), (2.0, 10.0), (7.0, 8.0))
    (folder / "scanner/filaments/00").mkdir(parents=True, exist_ok=True)
    for k in range(3):
        image = rng.integers(20, 40, (140, 90), dtype=np.uint8)
        for x, y in places:
            cv2.circle(image, (int(10 * x) + 2 * k, int(10 * y) + k), 3, 240, -1)
        cv2.imwrite(str(folder / f"scanner/filaments/00/{k}.png"), cv2.GaussianBlur(image, (0, 0), 1.0))
    screen = "{mm_per_px: [0.1, 0.1]}"
    (folder / "filaments.yaml").write_text(
        f"filaments: {{places_mm: {json.dumps(places)}, expanded_mm: 0.02, screen: {screen}}}\n", encoding="utf-8"
    )
    (folder / "upright.yaml").write_text("plane: {size_mm: [180, 60], form_mm: 0.002}\n", encoding="utf-8")
    mesh = trimesh.creation.cone(1.0, length, sections=6).apply_transform(np.diag([1.0, -1, -1, 1]))
    for suffix in (".stl", ".glb"):
        mesh.export(folder / f"needle{suffix}")
    drawn = np.array([12.0, -111.463, -155.128])  # of `scenes.handheld.looks.needle`, in its target's frame
    tip_files.write(folder / "needle_tip.yaml", Tip(drawn, np.eye(3), body="needle"))
    tip_files.write(folder / "small_tip.yaml", Tip(needle.tip, np.eye(6), needle.axis, body="needle"))


def _write_benchmark(folder: Path) -> None:
    """Truth of two sessions of the open benchmark, and somebody's results of these."""
    from recon.capture import calibration_files
    from recon.model.tracks import Track
    from sonotwin.choices import read_rig
    from twin.optics.surface_session import calibration_of

    optics, poses, times = calibration_of(read_rig()), np.stack([np.eye(4)] * 4), np.arange(4) * 10**8
    for name in ("000000-optics", "000001-tracking"):
        (folder / "sealed" / name / "calibration").mkdir(parents=True, exist_ok=True)
        (folder / "scored" / name).mkdir(parents=True, exist_ok=True)
        calibration_files.write(folder / "sealed" / name / "calibration/optics.yaml", optics)
    calibration_files.write(folder / "scored/000000-optics/calibration.yaml", optics)
    sweep_tables.write_track(folder / "scored/000001-tracking/poses.csv", Track(times, poses))
    (folder / "sealed/000001-tracking/sweep").mkdir(exist_ok=True)
    frames = {"times_ns": times, "world_from_target": poses, "blur_px": np.zeros((4, 2, 3))}
    frames |= {"visible": np.ones((4, 2, 3)), "inside": np.ones((4, 2, 3), bool)}
    np.savez(folder / "sealed/000001-tracking/sweep/film.npz", **frames)


def _write_rig(folder: Path) -> None:
    """A rig's file, as identified."""
    from datetime import date

    from recon.identification import rig_file
    from recon.identification.estimates import Estimate, Findings
    from sonotwin.choices import read_rig

    found = rig_file.apply(read_rig(), Findings({"projector.gamma": Estimate(2.21, 0.01, "made up")}))
    folder.mkdir(exist_ok=True)
    rig_file.write(folder / "rig.yaml", rig_file.next_version(found, "made up", date(2026, 5, 4)), {}, "made up")


def _pairs(folder: Path, noise_px: float = 0.0) -> str:
    """Poses and pixels of a crossing at rest, by a calibration that is there, a pair a line."""
    probe, rng = probe_files.read(folder / "probe" / "probe.yaml"), np.random.default_rng(0)
    names = [f"m{i}{j}" for i in range(3) for j in range(4)]
    lines = [",".join([*names, "u", "v"])]
    for pixel in rng.uniform([40, 60], [280, 340], (20, 2)):
        turn = Rotation.from_euler("xyz", rng.uniform(-30, 30, 3), degrees=True).as_matrix()
        pose = rigid.transform(turn, np.array([0.0, 0.0, 650.0]) - turn @ probe.to_target(pixel[None])[0])
        seen = pixel + noise_px * rng.standard_normal(2)
        lines.append(",".join(f"{value:.9g}" for value in (*pose[:3].ravel(), *seen)))
    return "\n".join(lines) + "\n"


PLUS = """<PlusConfiguration version="2.7">
  <VolumeReconstruction ImageCoordinateFrame="Image" ReferenceCoordinateFrame="Reference" OutputSpacing="0.5 0.5 0.5"
    ClipRectangleOrigin="0 0" ClipRectangleSize="321 408" Interpolation="NEAREST_NEIGHBOR" Optimization="FULL_OPTIMIZATION"
    CompoundingMode="MEAN" FillHoles="FALSE" />
</PlusConfiguration>
"""


def lay_out(folder: Path, sources: Path, names: Sequence[str]) -> None:
    """Fill a folder with some of the sources, as links to their files."""
    for name in names:
        source, target = sources / name, folder / name
        if source.is_dir():
            atomic.link_tree(source, target)
        else:
            target.hardlink_to(source)
