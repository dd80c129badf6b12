"""The command lines that do what a demonstration does, for its report."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from pydantic import BaseModel

from sonotwin.demo_config import BOARD_PATTERNS, CALIBRATION, ONE_SCANNER, WATER_C, Config
from sonotwin.verbs import calibrate_optics, calibrate_probe, film, render, sweep, track


def commands(folder: Path, config: Config, overrides: Sequence[str], lag_s: float) -> list[str]:
    """The command lines that do the same at once and step by step, with the settings that `sonotwin demo` was given."""
    camera = config.cameras[0]
    given = [override for override in overrides if not override.startswith("out=")]
    of_scene = _of(given, render.Config, without=("poses",))
    of_board = _of(given, render.Config, without=("scene", "patterns", "cameras", "shooting"))
    board, optics = config.board, folder / CALIBRATION / calibrate_optics.OPTICS
    choices = ["scene=board", "poses=demo", f"patterns={BOARD_PATTERNS}", "cameras=[cam1,cam2]"]
    calibrating = [
        ["render", *choices, *of_board, f"out={board}"],
        ["calibrate-optics", f"capture={board / 'capture'}", f"truth={board / 'truth'}", f"out={folder / CALIBRATION}"],
    ]
    calibrated = [f"calibration={optics}"] if config.poses else []
    lines = (
        ["demo", *given, f"out={folder}"],
        *(calibrating if config.poses else []),
        ["render", *of_scene, f"out={folder}"],
        ["surface", f"capture={folder / 'capture'}", *calibrated, f"camera={camera}", f"out={folder / 'surface'}"],
        [
            "evaluate",
            f"surface={folder / 'surface'}",
            f"truth={folder / 'truth'}",
            f"camera={camera}",
            f"out={folder / 'evaluation'}",
        ],
        *(sweep_commands(folder, config, given, lag_s) if config.looks_inside else []),
        *(film_commands(folder, config, given) if config.film_frames else []),
    )
    return [shlex.join(["sonotwin", *line]) for line in lines]


def sweep_commands(folder: Path, config: Config, given: Sequence[str], lag_s: float) -> list[list[str]]:
    """The same for the steps of the sweep, as words."""
    of_scanner = [override for override in given if override.startswith(ONE_SCANNER)]
    of_tank = ["ultrasound=water", *of_scanner, *_of(given, sweep.Config, without=("scene", "path", "ultrasound"))]
    path = [] if any(override.startswith("path=") for override in given) else ["path=raster"]
    placed = [
        f"capture={folder / 'sweep' / 'capture'}",
        f"probe={folder / 'probe' / calibrate_probe.PROBE}",
        f"lag_s={lag_s:.4f}",
        f"tissue_m_s={config.tissue_m_s:g}",
    ]
    return [
        ["sweep", "scene=crosswire", "path=wire", f"path.count={config.wires}", *of_tank, f"out={folder / 'wires'}"],
        [
            "calibrate-probe",
            *[override for override in given if override.startswith("rig")],
            f"capture={folder / 'wires' / 'capture'}",
            f"temperature_c={WATER_C:g}",
            f"out={folder / 'probe'}",
        ],
        ["sweep", "scene=tank", "path=bob", f"path.seconds={config.bottom_s:g}", *of_tank, f"out={folder / 'bottom'}"],
        ["measure-lag", f"capture={folder / 'bottom' / 'capture'}", f"out={folder / 'lag'}"],
        ["sweep", *path, *_of(given, sweep.Config), f"out={folder / 'sweep'}"],
        ["freehand", *placed, f"out={folder / 'volume'}"],
        [
            "segment",
            *placed,
            f"surface={folder / 'surface' / 'surface.ply'}",
            f"out={folder / 'tumours'}",
        ],
    ]


def film_commands(folder: Path, config: Config, given: Sequence[str]) -> list[list[str]]:
    """The same for the steps of the tracker, as words."""
    filmed = _of(given, film.Config, without=("path", "quality"))
    of_rig = [override for override in _of(given, track.Config) if override.startswith("rig")]
    return [
        ["film", *filmed, f"frames={config.film_frames}", f"out={folder / 'film'}"],
        ["track", *of_rig, f"capture={folder / 'film' / 'capture'}", f"out={folder / 'track'}"],
    ]


def _of(overrides: Sequence[str], model: type[BaseModel], without: Sequence[str] = ()) -> list[str]:
    """Those of the overrides that are of a model's fields."""
    wanted = set(model.model_fields) - set(without)
    return [override for override in overrides if override.lstrip("+~").partition("=")[0].partition(".")[0] in wanted]
