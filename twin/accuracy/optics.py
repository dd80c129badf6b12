"""How true the light transport is: against Mitsuba's own integrator, and against geometry."""

import numpy as np
from numpy.typing import NDArray

from recon.camera import Camera
from recon.patterns import CentreLine, Fringes, Patterns
from recon.phase import Noise, wrapped_phase
from recon.rig import Rig
from scenes.catalogue import build_scene
from scenes.things import Scene
from twin.accuracy.rows import Measurement, Row
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.raster import OVERSAMPLING, Light
from twin.optics.reference import ideal_rig, mitsuba_scene, render_pattern
from twin.optics.transport import Engine, Images, render
from twin.optics.truth import surface_truth
from twin.optics.world import build_world

BLOCK = 4  # px; z-scores are taken of block means, which are close to normal
COMPARED = (0, 2, 5)  # patterns of the paper's sequence: the centre line and two fringe images
REALISTIC_14 = (-0.11, 0.25, 0.0004, -0.0006, 0.02, 0.01, -0.02, 0.005, 0.001, -0.0005, -0.0008, 0.0004, 0.01, -0.008)
STRONG_14 = (-0.28, 0.12, 0.002, -0.003, -0.02, 0.05, 0.02, 0.01, 0.004, -0.002, 0.003, 0.001, 0.04, -0.03)


def measurements(rig: Rig) -> list[Measurement]:
    """The rows of the group, at full size."""
    return [
        lambda: [row for kind in ("plane", "breast") for row in against_mitsuba(rig, build_scene({"kind": kind}), 0.5, 128, 16)],
        lambda: [phase_error(rig, samples=16)],
        lambda: [round_trip(name, coefficients) for name, coefficients in (("realistic", REALISTIC_14), ("strong", STRONG_14))],
    ]


def paper_surface(projector_size: tuple[int, int]) -> Patterns:
    """The paper's surface sequence on a projector of any size."""
    parts = (CentreLine(), Fringes(pitch=12, steps=8, first=1))
    return Patterns(projector_size=projector_size, unwrap="centre_line", parts=parts)


def against_mitsuba(rig: Rig, scene: Scene, scale: float, samples: int, repeats: int) -> list[Row]:
    """Row a: z-scores of the difference to Mitsuba's `path`, pinholes and direct light."""
    z = mitsuba_z_scores(rig, scene, scale, samples, repeats)
    # The variances come from `repeats` renders each, so z follows Student's t with 2 (repeats - 1) degrees of freedom.
    freedom = 2 * (repeats - 1)
    return [
        Row(
            "a",
            f"{scene.name}: spread of z-scores against Mitsuba",
            float(z.std()),
            1.1,
            float(np.sqrt(freedom / (freedom - 2))),
            "sigma",
        ),
        Row("a", f"{scene.name}: mean z-score against Mitsuba", abs(float(z.mean())), 0.1, 0.0, "sigma"),
    ]


def mitsuba_z_scores(rig: Rig, scene: Scene, scale: float, samples: int, repeats: int) -> NDArray[np.float64]:
    """Difference between our render and Mitsuba's, in standard errors, one value a block of pixels and pattern.

    Both render `repeats` times with independent seeds, from which their variances are estimated.
    """
    camera, projector = ideal_rig(rig, scale)
    light = Light.of(paper_surface(projector.camera.size), rig.projector)
    ours_world, peer_world = build_world(scene), mitsuba_scene(scene, camera, projector, OVERSAMPLING)
    engine = Engine(samples=samples)
    ours = np.stack([block_means(render(ours_world, CameraOptics.pinhole(camera), projector, light, engine, seed))[list(COMPARED)]
                     for seed in range(repeats)])  # fmt: skip
    peer = np.stack([[block_means(render_pattern(peer_world, light, pattern, samples, 1000 + seed)) for pattern in COMPARED]
                     for seed in range(repeats)])  # fmt: skip
    error = np.sqrt((ours.var(axis=0, ddof=1) + peer.var(axis=0, ddof=1)) / repeats)
    difference = ours.mean(axis=0) - peer.mean(axis=0)
    bright = peer.mean(axis=0) > 0.02 * peer.mean(axis=0).max()  # where there is next to no light the means are not normal
    return difference[bright] / error[bright]


def block_means(images: Images) -> NDArray[np.float64]:
    """Means over BLOCK x BLOCK pixels : (..., h // BLOCK, w // BLOCK)."""
    height, width = (length // BLOCK * BLOCK for length in images.shape[-2:])
    blocks = images[..., :height, :width].reshape(*images.shape[:-2], height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    return blocks.mean(axis=(-3, -1), dtype=float)


def phase_error(rig: Rig, samples: int) -> Row:
    """Row c: phase error of a noise-free plane, through distortion, lenses and raster, in projector px."""
    patterns = paper_surface(rig.projector.optics.size)
    world = build_world(build_scene({"kind": "plane", "tilt_deg": [3.0, 12.0]}))
    light = Light.of(patterns, rig.projector)
    images = render(world, CameraOptics.of(rig.cam1), ProjectorOptics.of(rig.projector), light, Engine(samples=samples), seed=1)
    fringes = patterns.parts[1]
    assert isinstance(fringes, Fringes)
    phase = wrapped_phase(images[1:] * np.float32(200 / images.max()), fringes.shifts, noise=Noise(0, 0), saturation=np.inf).phase
    truth = surface_truth(world, rig.cam1.optics.camera(), rig.projector.optics.camera())
    true_phase = 2 * np.pi * (truth.projector[..., 0].astype(float) - fringes.zero(patterns.length("columns"))) / fringes.pitch
    error = np.angle(np.exp(1j * (phase - true_phase))) * fringes.pitch / (2 * np.pi)
    rms = float(np.sqrt(np.mean(error[truth.lit] ** 2)))
    return Row("c", f"plane, {samples} samples/px, no noise: RMS phase error", rms, 0.005, None, "projector px")


def round_trip(name: str, distortion: tuple[float, ...]) -> Row:
    """Row j: pixel to ray to pixel through 14 coefficients, the largest error in the image."""
    camera = Camera((1280, 1024), np.array([[3320.0, 0, 618], [0, 3331, 523], [0, 0, 1]]), np.array(distortion))
    grid = camera.pixel_grid()
    error = np.abs(camera.project(camera.rays(grid) * 650.0) - grid).max()
    return Row("j", f"14 coefficients, {name}: pixel to ray to pixel, largest error", float(error), 1e-3, None, "px")
