"""Unwrapping from the centre line: does a surface get the right order, and is a wrong one ever called right?"""

from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.model.patterns import CentreLine, Fringes, Patterns
from recon.structured_light.decode import Status, decode
from tests.recon.fringe_scenes import breast, island, photograph, whole_jumps

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(scope="module")
def patterns() -> Patterns:
    return Patterns(**yaml.safe_load((ROOT / "conf/patterns/paper_surface.yaml").read_text(encoding="utf-8")))


def wrong(found, x):
    """Pixels called OK whose column is off by more than a quarter period."""
    return (found.status == Status.OK) & ~(np.abs(found.columns - x) < 3)


def flood(phase, valid, line_pixels, turns):
    """The slow reference: walk from the line over valid pixels, each step to the nearest order."""
    height, width = phase.shape
    absolute = np.full(phase.shape, np.nan)
    stack = []
    for v, u in line_pixels:
        absolute[v, u] = phase[v, u] + np.rint(turns - phase[v, u])
        stack.append((v, u))
    while stack:
        v, u = stack.pop()
        for y, x in ((v, u + 1), (v, u - 1), (v + 1, u), (v - 1, u)):
            if 0 <= y < height and 0 <= x < width and valid[y, x] and np.isnan(absolute[y, x]):
                absolute[y, x] = phase[y, x] + np.rint(absolute[v, u] - phase[y, x])
                stack.append((y, x))
    return absolute


def test_a_smooth_surface_is_covered(rng, patterns):
    """A dome with a shadow, through a gamma: no wrong order, and more than 99 % of the lit pixels."""
    x = breast((512, 640))
    found = decode(photograph(patterns, {"columns": x}, rng, gamma=2.2), patterns)
    assert not wrong(found, x).any()
    assert np.mean(found.status[np.isfinite(x)] == Status.OK) > 0.99
    assert (found.status[np.isnan(x)] == Status.DARK).all()


def test_agrees_with_a_flood_fill(rng, patterns):
    """On a surface without steps a plain flood fill is right too; the fast unwrapping gives the same orders."""
    smooth = 639.5 + 0.55 * (np.mgrid[:120, :200][1] - 90.0) + 4 * np.sin(np.mgrid[:120, :200][0] / 30)
    found = decode(photograph(patterns, {"columns": smooth}, rng), patterns)
    line = [(60, int(np.abs(smooth[60] - 639.5).argmin()))]
    slow = 639.5 + 12 * flood(found.phase / (2 * np.pi), np.ones(smooth.shape, bool), line, 0.0)
    ok = found.status == Status.OK
    assert ok.mean() > 0.99
    assert found.columns is not None
    assert found.columns[ok] == pytest.approx(slow[ok], abs=1e-3)


def test_an_island_is_never_given_a_wrong_order(patterns):
    """An object beside the line, touching the background across a jump that passes whole periods: not one wrong pixel.

    Scenes in which most of the border jumps by whole periods, to 0.4 rad, are set aside: there the phase itself continues.
    """
    reported, kept = 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, inside = island(rng)
        images = photograph(patterns, {"columns": x}, rng, light=rng.uniform(40, 180))
        if whole_jumps(x, inside, 12) > 0.5:
            continue
        found = decode(images, patterns)
        kept += 1
        assert not wrong(found, x).any(), f"seed {seed}"
        assert np.mean(found.status[np.isfinite(x) & ~inside] == Status.OK) > 0.9, f"seed {seed}"
        reported += found.summary["islands"] >= 1 and np.mean(found.status[inside] == Status.UNREACHABLE) > 0.5
    assert reported >= 0.9 * kept > 10


def test_objects_on_the_line_all_get_their_order(rng, patterns):
    """Three plates at different heights, each crossed by the line: each is right, whatever lies between them."""
    v, u = np.mgrid[:360, :400].astype(float)
    height = np.array([0.0, 31.0, 11.0])[(v // 120).astype(int)]
    x = 639.5 + 0.55 * (u - 200) + height
    found = decode(photograph(patterns, {"columns": x}, rng), patterns)
    assert not wrong(found, x).any()
    assert np.mean(found.status == Status.OK) > 0.9
    assert found.summary["regions"] == 3


def test_shadow_gaps_do_not_shift_orders(rng, patterns):
    """Dark stripes and specks cut the surface; what is still connected is right, what is cut off is reported."""
    x = 639.5 + 0.55 * (np.mgrid[:300, :480][1] - 150.0) + 5 * np.sin(np.mgrid[:300, :480][0] / 50)
    x[:, 400:412] = np.nan  # cuts the right part off
    x[100:110, :380] = np.nan
    x[rng.random(x.shape) < 3e-4] = np.nan
    found = decode(photograph(patterns, {"columns": x}, rng), patterns)
    assert not wrong(found, x).any()
    lit = np.isfinite(x)
    assert np.mean(found.status[:, :400][lit[:, :400]] == Status.OK) > 0.97
    assert np.mean(found.status[:, 412:][lit[:, 412:]] == Status.UNREACHABLE) > 0.65
    assert not (found.status[:, 412:] == Status.OK).any()
    assert found.summary["islands"] >= 1


def test_horizontal_lines_work_the_same(rng):
    """The same surface turned by 90 degrees, with patterns along the rows, decodes to the same map."""
    parts = (CentreLine(axis="rows"), Fringes(axis="rows", pitch=12, steps=8, first=1))
    patterns = Patterns(projector_size=(800, 1280), unwrap="centre_line", parts=parts)
    x = np.ascontiguousarray(breast((512, 640)).T)
    found = decode(photograph(patterns, {"rows": x}, rng), patterns)
    ok = found.status == Status.OK
    assert found.columns is None
    assert np.abs(found.rows - x)[ok].max() < 3
    assert np.mean(ok[np.isfinite(x)]) > 0.98
