"""Calibrate the rendered rig, measure a phantom outside and inside with it, compare with the truth, and report the whole story.

Reads the same choices from conf/ as `sonotwin render`, `sonotwin sweep` and `sonotwin film`. Writes into the folder `out`:
report.html (open it in a browser; it needs no network), surface.ply (mm), surface.glb (metres, y up), metrics.json; capture/, one
session with the board, the scene under fringes and, of scenes with tumours, three filmed sweeps, and its truth/; result/, what
`sonotwin reconstruct` makes of the capture; of other scenes film/ and track/, a moving target and the tracker's poses. Takes
four to six minutes on two cores, half of that without ultrasound (path=none), and less without the film (film_frames=0); the
first run ever also compiles, for one or two. The board's images are kept and used again by all demonstrations of the same rig. A
run that was interrupted is simply started again.

    sonotwin demo
    sonotwin demo poses=paper path=none
    sonotwin demo scene=sphere patterns=gray_surface out=outputs/sphere
"""

from recon.files.metrics import Metrics, shown
from recon.files.occupied import occupied
from recon.tracking import networks
from scenes.catalogue import parse_scene
from sonotwin import demonstration, pipeline
from sonotwin.console_watch import LineConsole
from sonotwin.demonstration import Config
from twin import board_session
from twin.evaluation import sweep_errors
from twin.evaluation.surface_errors import things
from twin.session import CAPTURE, TRUTH, TWIN

# Folders of 0.1.0's demonstrations, beside which a new one writes.
EARLIER = ("calibration", "surface", "sweep", "wires", "bottom", "lag", "probe", "volume", "tumours", "scene", "poses")


def run(config: Config) -> None:
    """Play the steps, then print a summary in some lines.

    Raises
    ------
    InputError
        If a setting is wrong, the tracker's networks are missing, a step could not be done, `out` or `board` holds something
        else, or another demonstration is at work in `out`.
    """
    with occupied(config.out):
        _play(config, LineConsole())


def _play(config: Config, console: LineConsole) -> None:
    if config.looks_inside or config.film_frames:
        networks.load(kind=config.rig.target.kind)  # before minutes of work
    parse_scene(config.scene)
    if config.poses is not None:
        board_session.check_place(config.board)
    demonstration.check_place(config)
    if earlier := [name for name in EARLIER if (config.out / name).is_dir()]:
        console.print(
            f"stale       {', '.join(earlier)} in {config.out}: of an earlier version, and no part of this result", markup=False
        )
    found = pipeline.play(
        demonstration.steps(config),
        config.out,
        config.model_dump(mode="json"),
        lambda text: console.print(text, style="bold cyan", markup=False),
        {CAPTURE: TWIN, TRUTH: TWIN},
    )
    console.print()
    for line in summary(config, found):
        console.print(line, markup=False)


def summary(config: Config, found: Metrics) -> list[str]:
    """Results in some lines: accuracy, coverage, and the places of the files."""
    out, points = config.out, f"{found['points']:,}".replace(",", " ")
    parts = ", ".join(f"{name} {shown(value, '.3f')}" for name, value in things(found).items())
    return [
        f"measured    {points} points of the scene ({config.scene['kind']}) from {config.patterns.count} images, "
        f"in {found['seconds_demo']:.0f} s",
        f"accuracy    {shown(found['surface_rms_mm'], '.3f', ' mm')} RMS ({parts}); "
        f"the camera's noise alone would leave {shown(found['limit_rms_mm'], '.3f', ' mm')}",
        *calibrated(found),
        *looked_inside(config, found),
        *followed(found),
        f"coverage    {100 * found['coverage']:.1f} % of what camera and projector both see; "
        f"{100 * found['gross_error_fraction']:.3f} % of the points are off by more than 1 mm",
        f"look at     {out / 'report.html'}; the surface is in {out / 'surface.ply'} and {out / 'surface.glb'}",
    ]


def calibrated(found: Metrics) -> list[str]:
    """Figures of the calibration, if there was one."""
    if "point_error_rms_mm" not in found:
        return []
    remaining = ", ".join(f"{name} {found[f'reprojection_rms_{name}_px']:.3f}" for name in ("cam1", "cam2", "projector"))
    return [
        f"calibrated  from {found['poses']:.0f} poses: reprojection {remaining} px RMS; "
        f"points off by {found['point_error_rms_mm']:.3f} mm RMS for it, {found['point_sigma_mm']:.3f} mm predicted"
    ]


def looked_inside(config: Config, found: Metrics) -> list[str]:
    """Figures of the probe's calibration and of the tumours; or the reason why there are none."""
    if not config.looks_inside:
        return (
            []
            if config.path is None
            else [f"left out    ultrasound: nothing is to be found inside the scene ({config.scene['kind']})"]
        )
    errors = sweep_errors.of_each(found, "centre_error_mm")
    off = f", centres off by {', '.join(f'{error:.2f}' for error in errors)} mm" if errors else ""
    count = sum(value == 1 for value in sweep_errors.of_each(found, "inside"))
    false = f"; {found['tumours_false']} more are none" if found["tumours_false"] else ""
    return [
        f"probe       from {found['probe_frames_used']} B-scans of crossed wires: {found['probe_rms_mm']:.3f} mm RMS; image "
        f"centre known to {found['probe_sigma_centre_mm']:.3f} mm, by its own prediction",
        f"lag         {found['lag_ms']:.1f} ms, {found['lag_low_ms']:.1f} to {found['lag_high_ms']:.1f} ms (95 %), true "
        f"{1e3 * config.clocks.lag_s:.1f}; pixels of the sweep off by {found['placement_rms_mm']:.3f} mm RMS",
        f"tumours     {found['tumours_found']} of {found['tumours_true']} found, {count} inside the surface{off}{false}",
    ]


def followed(found: Metrics) -> list[str]:
    """Figures of the tracking, if there was a film."""
    if "track_found" not in found:
        return []
    medians = f"{shown(found['track_shift_median_mm'], '.3f', ' mm')} and {shown(found['track_turn_median_deg'], '.3f', ' deg')}"
    most = f"{shown(found['track_shift_p95_mm'], '.3f', ' mm')} and {shown(found['track_turn_p95_deg'], '.3f', ' deg')}"
    return [
        f"tracked     the target in {found['track_found']} of {found['track_frames']} frames, in {found['track_visible_found']} "
        f"of {found['track_visible']} that show it whole; off by {medians} in the median, 95 % by less than {most}"
    ]
