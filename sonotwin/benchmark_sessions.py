"""Sessions of the open benchmark: drawn from a seed that may be secret, rendered, and parted from their truth.

Session k is of the task TASKS[k % 4]. It depends on the seed and on k alone, whatever the engine and its workers.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from recon.capture.sweep_part import read_sweep
from recon.errors import InputError
from recon.files import atomic
from recon.files.code_digest import code_digest
from recon.freehand import scans
from recon.model import circle_layout
from recon.model.patterns import Patterns
from recon.model.rig import Optics, Rig
from scenes.catalogue import build_scene
from sonotwin import choices
from sonotwin.verbs import film, render
from twin.conditions import Conditions, in_use
from twin.evaluation.benchmark_results import FORMAT, ROUND, TASKS, WANTED, digest, files_of
from twin.experiments import drawn_rig
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.session import CAPTURE, TRUTH, Session, read_json, write_json
from twin.tracking import film_session

SESSIONS, DESCRIPTION, SUMS = "sessions", "session.json", "checksums.sha256"
BY = "render-benchmark"
MOST_LIFELIKE = 1.5  # of the errors of conf/conditions/lifelike.yaml, evenly from none
POSES, FRAMES = 8, 20  # of a board; pairs of a film
LAG_SIGMA_S = 0.002  # of the lag that a session states
TISSUE_M_S = 1450.0  # that a session states; the true speed differs by its conditions
TRIES = 100  # until masses find room in the breast


def name_of(number: int) -> str:
    """Name of a session, such as 000001-tracking."""
    return f"{number:06d}-{TASKS[number % len(TASKS)]}"


def commitment(seed: str) -> str:
    """SHA-256 of a round's seed, which may be published before the seed is."""
    return hashlib.sha256(seed.encode()).hexdigest()


def missing(out: Path, seed: str, count: int) -> list[int]:
    """Numbers of the sessions that aren't there yet; begins the round's description.

    Raises
    ------
    InputError
        If `out` holds another round or something else.
    """
    path, wanted, truths = out / ROUND, commitment(seed), dict[str, str]()
    if path.is_file():
        there = read_json(path)
        truths = there.get("truth_sha256", {})
        if there.get("seed_sha256") != wanted:
            raise InputError(f"{path}: seed_sha256: expected {wanted} of this seed, found another round; choose another out")
        if there.get("code_sha256") != code():
            raise InputError(
                f"{path}: code_sha256: expected {code()} of this version, found a round that another one began, which may make "
                "other bytes; go on with that one, or choose another out"
            )
        if int(there.get("sessions_count", 0)) > count:
            found = there["sessions_count"]
            raise InputError(f"{path}: sessions_count: expected {count} at most, found {found}; choose another out")
    elif out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: expected no folder, an empty one or a round of the benchmark, found something else")
    out.mkdir(parents=True, exist_ok=True)
    _describe_round(out, seed, count, truths)
    numbers = range(count)
    return [k for k in numbers if not (out / SESSIONS / name_of(k)).is_dir() or not (out / TRUTH / name_of(k)).is_dir()]


def write(out: Path, seed: str, number: int) -> str:
    """Render a session and its truth into their folders; returns its name."""
    name, task = name_of(number), TASKS[number % len(TASKS)]
    entropy = int.from_bytes(hashlib.sha256(f"{seed}/{number}".encode()).digest())
    making, quiet = out / ".making" / name, Console(quiet=True)
    rig, life = _drawn(choices.read_rig(), entropy)
    rng = np.random.default_rng([entropy, 1])
    about = {"optics": _optics, "tracking": _tracking, "surface": _surface, "ultrasound": _ultrasound}[task](
        making, rig, life, rng, quiet
    )
    places = {out / SESSIONS / name: BY, out / TRUTH / name: BY}
    with atomic.new_folders(places) as (shown, sealed):
        atomic.link_tree(making / CAPTURE, shown, leave_out=(".sonotwin.json",))
        atomic.link_tree(making / TRUTH, sealed, leave_out=(".sonotwin.json",))
        if task == "ultrasound":
            sweep = read_sweep(making / CAPTURE)
            assert sweep.probe is not None
            scans.write_sequence(shown / "sequence.igs.mha", sweep, sweep.probe, 0.0)
        write_json(shown / DESCRIPTION, {"format": f"{FORMAT}/session", "name": name, "task": task, **about})
    shutil.rmtree(making)
    return name


def finish(out: Path, seed: str, count: int) -> None:
    """Write the checksums of all sessions' files, and the round's description with those of the truth.

    Raises
    ------
    InputError
        If a truth isn't the one that the round was committed to.
    """
    shutil.rmtree(out / ".making", ignore_errors=True)  # what a killed run left
    truths = {name_of(k): digest(out / TRUTH / name_of(k)) for k in range(count)}
    for name, before in read_json(out / ROUND).get("truth_sha256", {}).items():
        if truths[name] != before:
            raise InputError(f"{out / TRUTH / name}: expected the truth of SHA-256 {before}, found another: was it edited?")
    _describe_round(out, seed, count, truths)
    with atomic.new_file(out / SUMS) as temporary:
        lines = [f"{digest}  {SESSIONS}/{place}\n" for place, digest in files_of(out / SESSIONS)]
        temporary.write_text("".join(lines), encoding="utf-8")


def code() -> str:
    """Digest of the code that a round is made by."""
    return code_digest("recon", "scenes", "sonotwin", "twin")


def _describe_round(out: Path, seed: str, count: int, truths: dict[str, str]) -> None:
    content = {
        "format": FORMAT,
        "licence": "CC0-1.0",
        "seed_sha256": commitment(seed),
        "code_sha256": code(),
        "sessions_count": count,
        "results": WANTED,
        "truth_sha256": truths,
    }
    with atomic.new_file(out / ROUND) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _drawn(rig: Rig, entropy: int) -> tuple[Rig, Conditions]:
    """Cameras and light as laboratories have them, the usual raster, and conditions from ideal to worse than lifelike."""
    drawn, _ = drawn_rig.draw(rig, entropy)
    projector = drawn.projector.model_copy(update={"optics": rig.projector.optics, "lens": rig.projector.lens})
    rng, usual = np.random.default_rng([entropy, 0]), choices.read("conditions", "lifelike")
    level = MOST_LIFELIKE * rng.random()
    scaled = {
        part: {name: value if name == "patch_mm" else level * value for name, value in fields.items()}
        for part, fields in usual.items()
    }
    return drawn.model_copy(update={"projector": projector}), Conditions.model_validate(scaled)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**32))


def _rendered(making: Path, rig: Rig, life: Conditions, rng: np.random.Generator, **fields: Any) -> render.Config:
    shared = {"tracing": choices.read("tracing", "default") | {"samples": 4}, "seed": _seed(rng), "shooting": {}}
    return render.Config.model_validate({"rig": rig, "conditions": life, "out": making, **shared, **fields})


def _optics(making: Path, rig: Rig, life: Conditions, rng: np.random.Generator, quiet: Console) -> dict[str, Any]:
    """A board in several poses, lit for each camera and under fringes for camera 1."""
    patterns = choices.read_patterns("paper_calibration").model_dump()
    parts = [part | {"steps": 6} if part["kind"] == "fringes" else part for part in patterns["parts"]]
    poses = choices.read("poses", "demo") | {"count": POSES, "seed": _seed(rng)}
    config = render.in_working_range(
        _rendered(
            making,
            rig,
            life,
            rng,
            scene=choices.read("scene", "board"),
            poses=poses,
            patterns=Patterns.model_validate(patterns | {"parts": parts}),
            cameras=["cam1", "cam2"],
        )
    )
    assert config.poses is not None
    render.render_board(config, config.poses, render.part_of(config), quiet)
    return {}


def _tracking(making: Path, rig: Rig, life: Conditions, rng: np.random.Generator, quiet: Console) -> dict[str, Any]:
    """A film of the hand-led target, in any light."""
    fields = {"frames": FRAMES, "white_dn": float(np.exp(rng.uniform(np.log(12), np.log(160))))}
    fields |= {"exposure_s": float(rng.uniform(0.002, 0.015)), "path": choices.read("path", "hand"), "seed": _seed(rng)}
    config = film.Config.model_validate({"rig": rig, "conditions": life, "out": making, **fields})
    session = Session(making, "sweep", config.model_dump(mode="json", exclude={"out", "add"}), devices=("cam1", "cam2"))
    used = in_use(rig, life, config.seed)
    bank = film_session.make_bank(used, film.ranges(), config, config.seed)
    made = film_session.takes(bank, used, film.ranges(), config, config.seed, life.motion)
    shot = film_session.shoot(bank, used, made, config.quality, config.seed)
    film_session.write_session(session, used, rig, config, made, shot)
    target = rig.target
    return {
        **_cameras(rig, "cam1", "cam2"),
        "circles_mm": circle_layout.circle_centres(target).tolist(),
        "outer_diameter_mm": target.outer_diameter_mm,
        "inner_diameter_mm": target.inner_diameter_mm,
    }


def _surface(making: Path, rig: Rig, life: Conditions, rng: np.random.Generator, quiet: Console) -> dict[str, Any]:
    """A body under fringes."""
    kind = ("breast", "patient", "two_objects", "sphere")[rng.integers(4)]
    scene = choices.read("scene", kind)
    if kind in ("breast", "patient"):
        scene |= {"seed": _seed(rng), "turn_deg": float(rng.uniform(-30, 30)), "reflectance": float(rng.uniform(0.3, 0.6))}
    patterns = choices.read_patterns("gray_surface")
    config = _rendered(making, rig, life, rng, scene=scene, patterns=patterns, cameras=["cam1"])
    render.render_surface(config, render.part_of(config), quiet)
    return {**_cameras(rig, "cam1", "projector"), "patterns": patterns.model_dump(mode="json")}


def _ultrasound(making: Path, rig: Rig, life: Conditions, rng: np.random.Generator, quiet: Console) -> dict[str, Any]:
    """A freehand stroke over a breast with masses."""
    scanner = choices.read("ultrasound", "clinic") | {"frequency_mhz": float(rng.uniform(5.5, 9))}
    scanner |= {"gain_db": float(rng.uniform(-39, -32)), "noise_db": float(rng.uniform(-80, -65))}
    along = {"start_mm": (4.0, -32.0), "end_mm": (4.0, 28.0), "speed_mm_s": float(rng.uniform(12, 25))}
    clocks = {"lag_s": float(rng.uniform(0, 0.15)), "scanner_jitter_s": float(rng.uniform(0, 0.004))}
    noise = {"turn_deg": float(np.exp(rng.uniform(-4, -1.5))), "shift_mm": float(np.exp(rng.uniform(-4.5, -1.5)))}
    fields = {"path": choices.read("path", "stroke") | along, "clocks": clocks, "pose_noise": noise, "seed": _seed(rng)}
    settings = SweepSettings.model_validate(
        {"rig": rig, "conditions": life, "ultrasound": scanner, "scene": _breast(rng), **fields}
    )
    planned = plan_sweep(settings)
    planned.write(Session(making, "sweep", settings.model_dump(mode="json"), devices=("us",)), planned.scans())
    probe = rig.probe
    return {
        "target_from_image": probe.target_from_image.matrix().tolist(),
        "scale_mm_per_px": list(probe.scale_mm_per_px),
        "lag_s": clocks["lag_s"] + LAG_SIGMA_S * float(rng.standard_normal()),
        "lag_sigma_s": LAG_SIGMA_S,
        "tissue_m_s": TISSUE_M_S,
        "assumed_m_s": settings.ultrasound.assumed_speed,
    }


def _breast(rng: np.random.Generator) -> dict[str, Any]:
    """The breast with one to three masses that the stroke passes over."""
    for _ in range(TRIES):
        count = int(rng.integers(1, 4))
        y = (np.arange(count) - (count - 1) / 2) * 44 / count
        tumours = [
            {
                "size_mm": float(rng.uniform(8, 16)),
                "centre_mm": [float(rng.uniform(-8, 8)), float(y[k] + rng.uniform(-2, 2)), float(rng.uniform(16, 28))],
                "form": ("round", "oval", "lobulated", "irregular")[rng.integers(4)],
                "echo_db": float(rng.uniform(-16, -8)),
            }
            for k in range(count)
        ]
        scene = choices.read("scene", "breast") | {"seed": _seed(rng), "tumours": tumours}
        try:
            build_scene(scene)
        except (InputError, ValueError):
            continue
        return scene
    raise InputError("benchmark: expected masses to find room in the breast, found none that did")


def _cameras(rig: Rig, *names: str) -> dict[str, Any]:
    """Devices as they were when they were calibrated, in OpenCV's terms."""
    found = {}
    for name in names:
        optics: Optics = getattr(rig, name).optics
        camera = optics.camera()
        found[name] = {
            "size_px": list(camera.size),
            "matrix_px": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "device_from_world": camera.camera_from_world.tolist(),
        }
    return {"devices": found}
