"""Frames for measurements of tracking, rendered on demand: unseen ones like training data, and studies."""

from collections.abc import Iterator
from dataclasses import replace

from recon.errors import InputError
from twin.experiments.experiment_setup import Setup
from twin.shooting import FilmQuality, Quality
from twin.tracking.mesh_bank import build_bank, build_bodies
from twin.tracking.rendered_views import Frames, render_film, render_full, render_sketches
from twin.tracking.samples import Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.study_samples import BLUR_PX, WHITE_DN, bodies_take, study_take
from twin.tracking.surface_prints import BitGrid

BATCH = 4  # takes in one launch
STUDY_VARIANTS = 12  # of bodies and surroundings
MOST_TRIES = 50  # poses for each that shows the target whole
FINE = FilmQuality(view=4, rim=64)  # of several bodies: fewer rays of cells leave more noise in shadows than sensors do
WHOLLY = 0.999  # of each disc: what a study asks to be seen of them


def exactly_printed(setup: Setup) -> Setup:
    """The same, its target known as it is rendered, to the last digit."""
    exact = setup.rig.target.model_copy(update={"tolerance_mm": 0.0})
    return replace(setup, rig=setup.rig.model_copy(update={"target": exact}))


def ranges_of(setup: Setup) -> DataRanges:
    """Ranges of frames; ValueError if the setup has none."""
    if setup.frames is None:
        raise ValueError("setup.frames: expected the ranges of conf/dataset.yaml, found none")
    return setup.frames


def unseen(setup: Setup, seed: int, samples: int) -> Iterator[tuple[Take, Frames]]:
    """Samples as of a data set of another seed, so with other bodies and surroundings too."""
    ranges = ranges_of(setup)
    bank = build_bank(setup.rig.target, ranges.variants, seed)
    for first in range(0, samples, BATCH):
        takes = [draw(ranges, setup.rig, seed, k) for k in range(first, min(first + BATCH, samples))]
        sketched = iter(render_sketches(bank, setup.rig, takes, Quality(), seed))
        for take, frames in zip(takes, sketched, strict=True):
            # false alarms are looked for in whole images: a sketch without target is coarse all over
            yield take, frames if take.present else render_full(bank, setup.rig, [take], Quality(), seed)[0]


def study(
    setup: Setup, seed: int, count: int, white_dn: float, blur_px: float, rays: int = 32, grid: BitGrid | None = None
) -> Iterator[tuple[Take, Frames]]:
    """Samples of set light and blur, over the whole working volume; nothing covers the target, by a look at few rays."""
    ranges = ranges_of(setup).model_copy(update={"variants": STUDY_VARIANTS})
    bank = build_bank(setup.rig.target, STUDY_VARIANTS, seed)
    given, k = 0, 0
    while given < count:
        if k > MOST_TRIES * count:
            raise InputError(
                f"film: expected targets that both cameras see whole, found {given} in {k} poses: too large, or too far off"
            )
        takes = [study_take(setup.rig, ranges, seed, number, white_dn, blur_px) for number in range(k, k + BATCH)]
        k += BATCH
        looked = render_sketches(bank, setup.rig, takes, Quality(window=2), seed, grid)
        clear = [take for take, one in zip(takes, looked, strict=True) if min(view.visible.min() for view in one.truth) > WHOLLY]
        clear = clear[: count - given]
        given += len(clear)
        if clear:
            yield from zip(clear, render_sketches(bank, setup.rig, clear, Quality(window=rays), seed, grid), strict=True)


def several(
    setup: Setup,
    seed: int,
    count: int,
    white_dn: tuple[float, float] = WHITE_DN,
    blur_px: tuple[float, float] = BLUR_PX,
    quality: FilmQuality = FINE,
) -> Iterator[tuple[Take, Frames]]:
    """Pairs of frames with all bodies of the rig, over the whole working volume; pair k depends on (seed, k) alone.

    Poses are those of `Take.held`, truth that of `Frames.bodies`, both by bodies' names. No circle is covered; light and blur lie
    within ranges, see `bodies_take`.
    """
    ranges = ranges_of(setup).model_copy(update={"variants": STUDY_VARIANTS})
    bank = build_bodies(setup.rig, STUDY_VARIANTS, seed)
    for first in range(0, count, BATCH):
        numbers = range(first, min(first + BATCH, count))
        takes = [bodies_take(bank, setup.rig, ranges, seed, k, white_dn, blur_px) for k in numbers]
        yield from zip(takes, render_film(bank, setup.rig, takes, quality, seed), strict=True)
