"""Patterns as images: the twin's light, the decoder's coordinates, black and white where the definitions have no grey."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.artwork import projected_images
from recon.model.patterns import CentreLine, Fringes, Patterns
from recon.structured_light.decode import decode

ROOT = Path(__file__).resolve().parents[3]
FILES = sorted((ROOT / "conf/patterns").glob("*.yaml"))
KNOWN = (
    0.99  # of the pixels: at the ends of the axis a heterodyne sequence, and Gray code without the complementary bit, leave some
)


def sequence(file):
    return Patterns(**yaml.safe_load(file.read_text(encoding="utf-8")))


def seen(images):
    """What a perfect camera of 12 bits on the projector's axis sees: each level by its own number, none of them saturated."""
    return np.uint16(100) + np.uint16(15) * images


def rounding_px(fringes):
    """Largest error by levels rounded to half a step: `2 / N sum |sin| / 255` rad."""
    turns = np.linspace(0, 2 * np.pi, 720)[:, None] + fringes.shifts
    return 2 / fringes.steps * np.abs(np.sin(turns)).sum(axis=1).max() / 255 * fringes.pitch / (2 * np.pi)


@pytest.fixture(scope="module", params=FILES, ids=lambda file: file.stem)
def drawn(request):
    """Each sequence and its images."""
    patterns = sequence(request.param)
    return patterns, projected_images.images(patterns)


def test_images_decode_to_the_projectors_pixels(drawn):
    """Within 0.01 px, or what eight bits allow: coarse fringes of few steps, 64 px by three, are off by up to 0.034 px."""
    patterns, images = drawn
    found = decode(seen(images), patterns, bits=12)
    height, width = found.status.shape
    for axis, values, true in (("columns", found.columns, np.arange(width)), ("rows", found.rows, np.arange(height)[:, None])):
        if axis not in patterns.axes:
            assert values is None
            continue
        sets = [part for part in patterns.parts if isinstance(part, Fringes) and part.axis == axis]
        allowed = max(0.01, rounding_px(min(sets, key=lambda part: part.pitch)) if sets else 0)
        assert np.isfinite(values).mean() > KNOWN
        assert np.nanmax(np.abs(values - true)) < allowed


def test_black_and_white_is_black_and_white(drawn):
    patterns, images = drawn
    shown = projected_images.shown(patterns)
    assert images.dtype == np.uint8 and images.shape == (patterns.count, *patterns.projector_size[::-1])
    assert len(shown) == patterns.count
    for (_, binary, _), image, row in zip(patterns.profiles(), images, shown, strict=True):
        assert row.binary == (set(np.unique(image)) <= {0, 255})
        assert row.binary or not binary


def test_light_is_the_twins():
    """Levels are those that the twin's projector shows, whose gamma it leaves to the device."""
    patterns = sequence(ROOT / "conf/patterns/paper_surface.yaml")
    levels = projected_images.images(patterns)[:, 0]
    assert [level.tolist() for level in levels] == [np.round(255 * profile).tolist() for _, _, profile in patterns.profiles()]


def test_linearised_levels_give_linear_light():
    """Behind a projector of that gamma, within a level; dark ones are coarser, as eight bits have none between."""
    patterns = sequence(ROOT / "conf/patterns/three_step_cue.yaml")
    light = (projected_images.images(patterns, gamma=2.2)[:, 0, 0] / 255) ** 2.2
    assert np.abs(light - patterns.images()[:, 0, 0]).max() < 2.2 * 0.5 / 255
    line = Patterns(projector_size=(64, 48), unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=8, steps=4)))
    assert set(np.unique(projected_images.images(line, gamma=2.2)[0])) == {0, 255}


def test_gamma_bends_few_steps_alone():
    names = {file.stem: projected_images.bent_by_gamma(sequence(file)) for file in FILES}
    assert {name for name, steps in names.items() if steps} == {"three_step_cue"}


def test_patterns_are_said_in_words():
    shown = projected_images.shown(sequence(ROOT / "conf/patterns/gray_surface.yaml"))
    assert [shown[0].what, shown[0].shift_deg, shown[-1].what] == [
        "fringe 1 of 8, columns, pitch 12 px, shift 45 deg",
        45.0,
        "complementary bit, columns, pitch 12 px",
    ]
    assert [row.bit for row in shown] == [None] * 8 + list(range(1, 9))
