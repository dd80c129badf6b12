"""Accuracy of the light transport: against Mitsuba's own integrator, and against geometry."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.model.patterns import CentreLine, Fringes, Patterns
from recon.model.rig import Rig
from recon.structured_light.phase import Noise, wrapped_phase
from scenes.catalogue import build_scene
from scenes.scene_types import Scene
from twin.evaluation.surface_errors import rms
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Images, Tracing, render
from twin.optics.mitsuba_reference import ideal_rig, mitsuba_scene, render_shown, show_pattern
from twin.optics.raster import OVERSAMPLING, Light
from twin.optics.ray_world import build_world
from twin.optics.surface_truth import surface_truth

BLOCK = 4  # px; z-scores are taken of block means, which are close to normal
LENSES = {  # coefficients of distortion
    "realistic": (-0.11, 0.25, 0.0004, -0.0006, 0.02, 0.01, -0.02, 0.005, 0.001, -0.0005, -0.0008, 0.0004, 0.01, -0.008),
    "strong": (-0.28, 0.12, 0.002, -0.003, -0.02, 0.05, 0.02, 0.01, 0.004, -0.002, 0.003, 0.001, 0.04, -0.03),
}


def paper_surface(projector_size: tuple[int, int]) -> Patterns:
    """The paper's surface sequence on a projector of any size."""
    parts = (CentreLine(), Fringes(pitch=12, steps=8, first=1))
    return Patterns(projector_size=projector_size, unwrap="centre_line", parts=parts)


def against_mitsuba(setup: Setup, kind: str, patterns: int, scale: float = 0.5, samples: int = 32, repeats: int = 16) -> Figures:
    """z-scores of the difference to Mitsuba's `path`, pinholes and direct light."""
    z = z_scores(*both_renders(setup.rig, build_scene({"kind": kind}), scale, samples, repeats, range(patterns)))
    # Mitsuba's independent samples have nearly all of the variance, so z follows Student's t with repeats - 1 degrees of freedom.
    return {"z_spread": z.std(), "spread_of_t": np.sqrt((repeats - 1) / (repeats - 3)), "z_mean": abs(z.mean())}


def both_renders(
    rig: Rig, scene: Scene, scale: float, samples: int, repeats: int, patterns: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Block means of our renders and of Mitsuba's : (repeats, patterns, h, w) each, with independent seeds."""
    camera, projector = ideal_rig(rig, scale)
    light = Light.of(paper_surface(projector.camera.size), rig.projector)
    ours_world, peer_world = build_world(scene), mitsuba_scene(scene, camera, projector, OVERSAMPLING)
    optics, tracing = CameraOptics.pinhole(camera), Tracing(samples=samples)
    ours = [block_means(render(ours_world, optics, projector, light, tracing, seed))[list(patterns)] for seed in range(repeats)]
    peer = []
    for pattern in patterns:
        show_pattern(peer_world, light, pattern)
        peer.append([block_means(render_shown(peer_world, samples, 1000 + seed)) for seed in range(repeats)])
    return np.stack(ours), np.stack(peer, axis=1)


def z_scores(ours: NDArray[np.float64], peer: NDArray[np.float64]) -> NDArray[np.float64]:
    """Difference of two renders' means over repeats (the first axis), in standard errors, where there is light."""
    error = np.sqrt((ours.var(axis=0, ddof=1) + peer.var(axis=0, ddof=1)) / len(peer))
    mean = peer.mean(axis=0)
    bright = mean > 0.02 * mean.max()  # where there is next to no light the means are not normal
    return (ours.mean(axis=0) - mean)[bright] / error[bright]


def block_means(images: Images) -> NDArray[np.float64]:
    """Means over BLOCK x BLOCK pixels : (..., h // BLOCK, w // BLOCK)."""
    height, width = (length // BLOCK * BLOCK for length in images.shape[-2:])
    blocks = images[..., :height, :width].reshape(*images.shape[:-2], height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    return blocks.mean(axis=(-3, -1), dtype=float)


def phase_error(setup: Setup, samples: int) -> Figures:
    """Phase error of a noise-free plane, through distortion, lenses and raster, in projector px."""
    rig = setup.rig
    patterns = paper_surface(rig.projector.optics.size)
    world = build_world(build_scene({"kind": "plane", "tilt_deg": [3.0, 12.0]}))
    light = Light.of(patterns, rig.projector)
    images = render(world, CameraOptics.of(rig.cam1), ProjectorOptics.of(rig.projector), light, Tracing(samples=samples), seed=1)
    fringes = patterns.parts[1]
    assert isinstance(fringes, Fringes)
    phase = wrapped_phase(images[1:] * np.float32(200 / images.max()), fringes.shifts, noise=Noise(0, 0), saturation=np.inf).phase
    truth = surface_truth(world, rig.cam1.optics.camera(), rig.projector.optics.camera())
    true_phase = 2 * np.pi * (truth.projector[..., 0].astype(float) - fringes.zero(patterns.length("columns"))) / fringes.pitch
    error = np.angle(np.exp(1j * (phase - true_phase))) * fringes.pitch / (2 * np.pi)
    return {"phase_rms_px": rms(error[truth.lit])}


def round_trip(setup: Setup, lens: str) -> Figures:
    """Pixel to ray to pixel through 14 coefficients, the largest error in the image."""
    camera = Camera((1280, 1024), np.array([[3320.0, 0, 618], [0, 3331, 523], [0, 0, 1]]), np.array(LENSES[lens]))
    grid = camera.pixel_grid()
    return {"error_px": np.abs(camera.project(camera.rays(grid) * 650.0) - grid).max()}
