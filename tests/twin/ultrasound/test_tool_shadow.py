"""Shadows of tools, beside a wave that is carried from the aperture to the rod's depth, cut there, and carried on."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.acoustics import Tissue
from tests.twin.ultrasound.test_tool_echoes import POSE, SOFT, rod
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.tool_echoes import Tool
from twin.ultrasound.tool_shadow import shaded
from twin.ultrasound.transducer import Transducer

ROD = 15.0  # mm, depth of a rod's axis
STEP = 0.01


def one_way(array: Transducer, apodised: bool, width: float, focus: float, depth: float, radius: float, beside: float) -> complex:
    """What is left in the middle of a beam behind an opaque strip, in one direction; Huygens' sums from screen to screen."""
    s = np.arange(-width / 2 + STEP / 2, width / 2, STEP)
    x = np.arange(-6, 6, STEP)
    k = 2 * np.pi / array.wavelength_mm
    sent = (np.cos(np.pi * s / width) ** 2 if apodised else np.ones(len(s))) * np.exp(-0.5j * k * s**2 / focus)
    at_rod = np.exp(0.5j * k * (x[:, None] - s) ** 2 / ROD) @ sent
    onwards = np.exp(0.5j * k * x**2 / (depth - ROD)) * np.cos(np.pi / 2 * np.clip(np.abs(x) - 5, 0, 1)) ** 2
    return (at_rod * onwards * (np.abs(x - beside) > radius)).sum() / (at_rod * onwards).sum()


def left(array: Transducer, heading_deg: float, beside: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Depths, and what is left of the two-way beam down the middle line, of a long rod parallel to the face."""
    tip = (25.0, ROD, beside) if heading_deg == 0 else (beside, ROD, 25.0)
    shaft = replace(rod(array, 0, tip, heading_deg, length=90.0), radius=radius)
    paths = follow(Body(SOFT, (), ()), array, POSE)
    found = shaded(paths, [Tool(shaft)], array, POSE)
    line = array.image_size[0] // 2
    return paths.step_mm * np.arange(paths.labels.shape[1]), found.amplitude[line] / paths.amplitude[line]


@pytest.mark.parametrize("radius", [0.255, 0.4, 0.8])
@pytest.mark.parametrize("beside", [0.0, 0.5, 1.2])
def test_in_the_plane_it_hides_what_fills_the_slice(clean, radius, beside):
    """The aperture's height is blocked both ways alike: to 5 % of what there would be."""
    depths, found = left(clean, 0, beside, radius)
    for depth in (18.0, 22.0, 30.0, 44.0):
        expected = abs(one_way(clean, False, clean.elevation_mm, clean.elevation_focus_mm, depth, radius, beside)) ** 2
        assert np.interp(depth, depths, found) == pytest.approx(min(expected, 1), abs=0.06)


@pytest.mark.parametrize("beside", [0.0, 1.0])
def test_across_the_plane_sound_passes_on_both_sides(clean, beside):
    """Hann's apertures along the array, the received one as wide as the depth asks for: the shadow fills up.

    Places between those that are summed, three lines apart, miss ripples of some hundredths.
    """
    depths, found = left(clean, 90, beside, 0.4)
    expected = []
    for depth in (18.0, 22.0, 30.0, 44.0):
        send = clean.transmit_focus_mm / clean.transmit_f_number
        transmit = one_way(clean, True, send, clean.transmit_focus_mm, depth, 0.4, beside)
        receive = one_way(clean, True, min(depth / clean.receive_f_number, clean.aperture_mm), depth, depth, 0.4, beside)
        expected.append(min(abs(transmit), 1) * min(abs(receive), 1))
        assert np.interp(depth, depths, found) == pytest.approx(expected[-1], abs=0.08)
    assert beside or (expected[-1] > 0.45 and expected[0] < 0.25)


def test_before_it_and_beside_its_tip_nothing_is_hidden(clean):
    shaft = rod(clean, 20, (0.0, ROD, 0.0))
    paths = follow(Body(SOFT, (), ()), clean, POSE)
    kept = shaded(paths, [Tool(shaft)], clean, POSE).amplitude / paths.amplitude
    per_mm, middle = 1 / paths.step_mm, clean.image_size[0] // 2
    assert (kept[middle + 60 :] > 0.97).all(), "7 mm beside the tip"
    assert (kept[: middle - 40, : int(2 * per_mm)] > 0.97).all() and kept[middle - 40, int(20 * per_mm)] < 0.3
    elsewhere = rod(clean, 20, (0.0, ROD, 6.0))
    assert (shaded(paths, [Tool(elsewhere)], clean, POSE).amplitude > 0.94 * paths.amplitude).all()


def test_speckle_is_darker_behind_it_by_that(clean):
    """Mean power behind a rod in the plane over that of the same tissue without: the two-way share, to 1 dB."""
    tissue = Body(Tissue(1.6, 1540.0, 0.0, 0.0), (), ())
    shaft = replace(rod(clean, 0, (30.0, ROD, 0.6), length=90.0), radius=0.3)
    rows, columns = slice(235, 275), slice(60, 260)
    plain, hidden = (scan(tissue, clean, POSE, 2, tools=tools).envelope[rows, columns] for tools in ((), (Tool(shaft),)))
    depths, found = left(clean, 0, 0.6, 0.3)
    expected = np.interp(31.2, depths, found)
    assert 0.1 < expected < 0.9
    assert 10 * np.log10((hidden**2).mean() / (plain**2).mean()) == pytest.approx(20 * np.log10(expected), abs=1.0)
