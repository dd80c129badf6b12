"""Light on the skin: from three masses to the projector's picture."""

from benchmarks.surface_speed import median_ms
from recon.skin_projection import mass_outline, projector_image
from twin.experiments import live_skin_accuracy as light
from twin.experiments.experiment_setup import Figures, Setup

REPEATS = 15


def picture(setup: Setup) -> Figures:
    """The breast's three masses on its skin as measured, some 750 000 triangles, to an image of 1280x800."""
    skin, masses = light.measured(setup, light.BREAST), light.tumours(light.BREAST)
    projector = setup.rig.projector
    curves = list(mass_outline.outlines(masses, skin).values())

    outlining = median_ms(lambda: mass_outline.outlines(masses, skin), REPEATS)
    drawing = median_ms(lambda: projector_image.draw(curves, skin, projector.optics.camera(), projector.gamma), REPEATS)
    return {"together_ms": outlining + drawing, "outlining_ms": outlining, "drawing_ms": drawing}
