"""Write a capture in another group's layout, for their programs.

A program's name, such as `layout=kalibr`, `ros`, `mrcal` or `slstudio`, is for the calibration of cameras and projector alone, of
a capture or as a file: Kalibr's camchain.yaml, ROS's camera_info and mrcal's cameramodel with a file a device, SLStudio's
calibration.xml. `layout=meza2021` is that of the rig's authors: SLdata/images and mask.png, USdata/L, R, US and USmasks with
target_pose.npy, and the files of all calibrations, US_params.npz for a chosen speed of sound. `layout=us_calibration` is for
their calibration of the probe: data1, data2, ... of a capture each, with L, R, UScrop, target_pose.npy, and cross_point.npy of
the crossings found, beside cam1_cam2.npz and their config.yaml. The pose is that of the frames in L/ and R/, taken a little
before or after the B-scan; `frames=false` writes B-scans alone, each with its own pose. `layout=markerpose` is for the training
of their networks: of data sets, data_centers.csv with images/, patch120/ and mask120/; and for their example: of a film,
images/L, R and StereoParams.xml. `layout=screen` is a scanner's own recording: screen/ of whole screens, with the B-scan in its
place and a clock, and poses.csv, the tracker's table; prints the command by which `sonotwin import-sweep` reads them back.

`layout=dicom` is for a hospital's archive, of results instead of a capture: one study of volume.dcm (Enhanced US Volume),
masses.dcm (Segmentation), surfaces.dcm (Surface Segmentation) and report.dcm (Comprehensive 3D SR, by TID 1500), as far as there
are masses and a surface. It names nobody but by a file that is given as `patient`; the same results have the same identifiers.
`sonotwin import-results` reads it back.

Reads a capture folder, of a sweep with poses, as `sonotwin track` and `sonotwin reconstruct` leave it, and results of other verbs
for what a capture doesn't hold. B-scans without a pose are left out, but of a recording. Writes into the folder `out`; an earlier
export there is replaced whole, and nothing else ever is. Takes seconds.

    sonotwin export capture=session/capture out=dataset
    sonotwin export layout=kalibr calibration=optics.yaml out=for_kalibr
    sonotwin export capture=result/poses/scan probe=result/probe/probe.yaml lag_s=0.05 tissue_m_s=1450 out=dataset
    sonotwin export capture=result/poses/scan surface=result/surface masses=result/masses/scan lag_s=0.05 out=dataset
    sonotwin export layout=us_calibration capture=[first/poses/wires,second/poses/wires] out=for_their_calibration
    sonotwin export layout=markerpose data=outputs/data out=for_their_training
    sonotwin export layout=markerpose capture=outputs/film/capture networks=[detector,segmenter] out=for_their_example
    sonotwin export layout=screen capture=outputs/sweep/capture out=recording
    sonotwin export layout=dicom volume=result/volume/scan masses=result/masses/scan surface=result/surface out=for_archive
"""

from recon import registry
from recon.capture import calibration_files
from recon.errors import InputError
from recon.files import atomic
from sonotwin import export_layouts, exported_cameras
from sonotwin.console_watch import LineConsole


class Config(export_layouts.Settings):
    """Fields of `sonotwin export`."""


def run(config: Config) -> None:
    """Write what the layout has a place for.

    Raises
    ------
    InputError
        If a source is incomplete or damaged, or has nothing for the layout, a field is given that the layout doesn't take, or
        `out` can't be written to.
    """
    console = LineConsole()
    given = (*config.capture, config.calibration, config.surface, config.probe, config.masses, config.volume, config.patient)
    given += (*config.data, *config.networks)
    atomic.check_folder(config.out, "export", inputs=given)
    of_cameras = config.layout in calibration_files.written()
    kind = exported_cameras if of_cameras else registry.kind(export_layouts.__name__, config.layout)
    for name, field in Config.model_fields.items():
        if name not in ("layout", "out", *kind.TAKES) and (value := getattr(config, name)) != field.default:
            raise InputError(f"export: {name}: expected none with layout={config.layout}, which is {kind.ABOUT}, found {value}")
    with console.status("writing"), atomic.new_folder(config.out, "export") as folder:
        lines = kind.write(folder, config)
    for line in [*lines, f"wrote       {config.out}"]:
        console.print(line, markup=False)
