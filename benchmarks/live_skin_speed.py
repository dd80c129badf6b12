"""Light on the skin: from three masses to the projector's picture."""

from benchmarks.surface_speed import median_ms
from recon.model.rig import Rig
from recon.skin_projection import mass_outline, projector_image
from sonotwin.config import compose
from sonotwin.verbs.accuracy import setup_of
from twin.experiments import live_skin_accuracy as light
from twin.experiments.table_rows import Measurement, Row

REPEATS = 15
MOST_MS = 1000


def measurements() -> list[Measurement]:
    """The rows of the part."""
    return [picture]


def picture() -> list[Row]:
    """Row f: the breast's three masses on its skin as measured, some 750 000 triangles, to an image of 1280x800."""
    rig = Rig.model_validate(compose("render", ["out=unused"])["rig"])
    skin, masses, projector = (
        light.measured(setup_of(rig), light.BREAST),
        light.tumours(light.BREAST),
        rig.projector.optics.camera(),
    )
    curves = list(mass_outline.outlines(masses, skin).values())

    outlining = median_ms(lambda: mass_outline.outlines(masses, skin), REPEATS)
    drawing = median_ms(lambda: projector_image.draw(curves, skin, projector, rig.projector.gamma), REPEATS)
    name = "three masses on the measured breast"
    return [
        Row("f", f"{name}: from masses to the projector's picture, median", outlining + drawing, MOST_MS, None, "ms"),
        Row("f", f"{name}: of that, outlines on the skin", outlining, None, None, "ms"),
        Row("f", f"{name}: of that, the picture of 1280x800", drawing, None, None, "ms"),
    ]
