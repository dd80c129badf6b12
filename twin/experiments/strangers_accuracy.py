"""Recordings of strangers: other scanners, probes and brackets, of which nothing is known beforehand, and real ones at hand."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from recon.clips import fan_region
from recon.geometry import rigid
from recon.model.fan import Fan
from recon.model.rig import Rig
from recon.probe_calibration import latency, point_calibration, repeatability, sound_in_water
from recon.probe_calibration.point_calibration import Noise
from scenes.catalogue import build_scene
from scenes.kinds import crosswire
from twin.experiments import probe_accuracy
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.probe_accuracy import SHIFT_MM, TEMPERATURE_C, TURN_DEG, WIRE_MM
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import scans
from twin.ultrasound.echo_solids import body
from twin.ultrasound.faces.curved import Face
from twin.ultrasound.probe_path import Bob, WirePath, about_crossing
from twin.ultrasound.sweep_session import calibration_of
from twin.ultrasound.timed_sweep import Clocks, PoseNoise
from twin.ultrasound.transducer import Transducer

SEED = 20
SCANNERS = (  # image size px, width of the array and depth mm, MHz
    ((640, 480), (38.0, 40.0), 10.0),
    ((512, 512), (50.0, 60.0), 7.5),
    ((400, 600), (30.0, 45.0), 12.0),
)
IMAGES = 30  # of crossed wires
FANS = ((40.0, 70.0, 3.5), (60.0, 58.0, 3.5), (50.0, 66.0, 5.0), (15.0, 110.0, 6.5))  # radius mm, sector deg, MHz
FAN_IMAGES = 12
FAN_DEPTH_MM = 100.0
LAG_S = 0.07


def foreign_probes(setup: Setup) -> Figures:
    """Probes of other scanners on other brackets, calibrated without a design, from the twin's crossed wires."""
    rng = np.random.default_rng(SEED)
    wired, errors, sigmas = body(crosswire.build(crosswire.Config(diameter_mm=2 * WIRE_MM))), [], []
    for size, extent_mm, mhz in SCANNERS:
        scale = extent_mm[0] / (size[0] - 1), extent_mm[1] / (size[1] - 1)
        array = setup.scanners["water"].model_copy(
            update={"image_size": size, "scale_mm_per_px": scale, "frequency_mhz": mhz, "transmit_focus_mm": extent_mm[1] / 2}
        )
        rig = _on_a_bracket(setup.rig, array, rng)
        track, _ = about_crossing(WirePath(count=IMAGES, roll_deg=90.0), wired, array)
        frames = probe_accuracy.looked_at(wired, array, track.poses[:: len(track.poses) // IMAGES][:IMAGES])
        seen = replace(frames.found, poses=probe_accuracy.tracked(rig, frames.found.poses, rng))
        found = point_calibration.calibrate(seen, size, Noise(TURN_DEG, SHIFT_MM)).calibration
        truth, points = calibration_of(rig, array), repeatability.five_points(size)
        in_water = sound_in_water.in_medium(truth, truth.speed_m_s, float(sound_in_water.speed_of_sound(TEMPERATURE_C)))
        errors.append(np.linalg.norm(found.to_target(points) - in_water.to_target(points), axis=1))
        sigmas.append(np.sqrt(np.trace(point_calibration.point_covariance(found, points), axis1=1, axis2=2)))
    worst = {"error_mm": np.max(errors), "sigma_mm": np.max(sigmas), "ratio": (np.array(errors) / np.array(sigmas)).max()}
    return worst | {"probes": len(SCANNERS), "images": IMAGES}


def _on_a_bracket(rig: Rig, array: Transducer, rng: np.random.Generator) -> Rig:
    """The rig with another scanner, and its target turned any way and 60 to 120 mm from the image."""
    pose = rig.probe.target_from_image
    turn = tuple(np.rad2deg(Rotation.random(rng=rng).as_rotvec()).tolist())
    way = rng.standard_normal(3)
    place = tuple((way / np.linalg.norm(way) * rng.uniform(60, 120)).tolist())
    other = pose.model_copy(update={"rotation_deg": turn, "translation_mm": place})
    fields = {"image_size": array.image_size, "scale_mm_per_px": array.scale_mm_per_px, "target_from_image": other}
    return rig.model_copy(update={"probe": rig.probe.model_copy(update=fields)})


def fans(setup: Setup) -> Figures:
    """Fans found in what changes, over tissue, of arrays of several radii."""
    tissue = body(build_scene({"kind": "breast"}))
    off, agree = [], []
    for radius, sector, mhz in FANS:
        array, truth = curved(setup.scanners["curved"], radius, sector, mhz)
        pose = rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (0.0, 0.0, 655.0))
        centred = rigid.transform(np.eye(3), (-array.face_mm[0], -array.face_mm[1], 0.0))
        poses = np.stack([rigid.transform(np.eye(3), (0.0, 1.5 * k, 0.0)) @ pose @ centred for k in range(FAN_IMAGES)])
        images = [one.image for one in scans(tissue, array, poses, SEED)]
        found = fan_region.find(images, "fans")
        off.append([abs(found.left_deg - truth.left_deg), abs(found.right_deg - truth.right_deg)])
        agree.append(_agreement(found, truth, (array.image_size[1], array.image_size[0])))
    return {"arrays": len(FANS), "images": FAN_IMAGES, "angle_deg": np.max(off), "common": np.min(agree)}


def curved(like: Transducer, radius: float, sector: float, mhz: float) -> tuple[Transducer, Fan]:
    """A curved array that shows FAN_DEPTH_MM, and its fan in the image."""
    face = Face(radius_mm=radius, sector_deg=sector, lines=256)
    half, pixel = np.deg2rad(sector / 2), 0.25
    size = (int(2 * (radius + FAN_DEPTH_MM) * np.sin(half) / pixel) + 9, int((FAN_DEPTH_MM + face.sagitta_mm) / pixel) + 1)
    fields = {"curved": face, "image_size": size, "scale_mm_per_px": (pixel, pixel), "frequency_mhz": mhz}
    array = like.model_copy(update=fields)
    u, v = array.face_mm[0] / pixel, (array.face_mm[1] - radius) / pixel
    return array, Fan(u, v, radius / pixel, (radius + array.rows_mm[-1]) / pixel, -sector / 2, sector / 2)


def _agreement(found: Fan, truth: Fan, shape: tuple[int, int]) -> float:
    one, other = found.mask(shape), truth.mask(shape)
    return float((one & other).sum() / (one | other).sum())


def curved_lag(setup: Setup) -> Figures:
    """The lag of a curved array over a tank's bottom, its fan found."""
    array, tank = setup.scanners["curved"], body(build_scene({"kind": "tank"}))
    planned = sweep_session.plan_sweep(Bob(), setup.rig, tank, array, Clocks(lag_s=LAG_S), PoseNoise(), SEED)
    images = [one.image for one in scans(tank, array, planned.truth.poses, SEED)]
    part = fan_region.find(images, "bottom").mask((array.image_size[1], array.image_size[0]))
    depths = np.array([latency.bottom_depth(image, part=part) for image in images])
    found = latency.estimate(planned.times, depths, planned.track)
    error = {"error_ms": 1e3 * abs(found.seconds - LAG_S), "predicted_ms": 1e3 * found.sigma_s}
    return error | {"images": len(images), "shown": np.isfinite(depths).mean()}
