"""Figures of tools in words: an alarm has its word, each row its place, and no old figure stays."""

import re

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation import moment_figures, tool_figures
from recon.navigation.publishing import BodyAt, Moment, StillScene
from recon.navigation.tool_distances import AtPlane, Crossing, Distance, FromPath, TipFigures
from recon.navigation.tool_figures import Alarms

POSE = rigid.transform(np.eye(3), [0, 0, 640])
TIP = Tip(np.array([0.0, 0, -150]), np.eye(6), np.array([0.0, 0, -1]))
BALL = trimesh.creation.icosphere(1, 5.0)
SCENE = StillScene(
    np.eye(4), masses={"mass0": BALL, "mass1": BALL}, tools={"needle": TIP}, plan=np.array([[0, 0, 0], [0, 0, 9.0]])
)
CROSSING = Crossing(np.array([10.0, 20]), -3.21, True)


def figures(masses=(12.34, 40.0), off=0.5, angle=1.0, left=23.0, crossing=CROSSING):
    return TipFigures(
        np.zeros(3),
        np.eye(3),
        np.array([0.0, 0, 1]),
        {f"mass{k}": Distance(mm, 0.42) for k, mm in enumerate(masses)},
        FromPath(off, 0.31, left, angle),
        AtPlane(-3.1, 0.2, crossing, None),
    )


def moment(found=None, state="predicted", pose=POSE):
    return Moment(1, 0, POSE, "target predicted", bodies=(BodyAt("needle", state, pose, pose, found),))


def rows(html):
    """Cells of each row with its class, as text."""
    return [
        (re.search('<tr(?: class="(.*?)")?', row)[1], *re.findall(r">([^<]*)</t[hd]>", row))
        for row in re.findall("<tr.*?</tr>", html)
    ]


def test_each_figure_stands_under_its_name():
    assert rows(tool_figures.html_of(moment(figures()), SCENE, Alarms())) == [
        (None, "needle", "tip, mm", "note"),
        (None, "predicted"),
        (None, "mass0", "12.3 ± 0.4", "–"),
        (None, "mass1", "40.0 ± 0.4", "–"),
        (None, "off path", "0.5 ± 0.3", "–"),
        (None, "tilt", "1.0°", "–"),
        (None, "to aim", "23.0", "–"),
        (None, "off image", "−3.1 ± 0.2", "–"),
        (None, "crossing", "3.2 behind", "in image"),
    ]


@pytest.mark.parametrize(
    ("found", "row"),
    [
        ({"masses": (-0.2, 40)}, ("alarm", "mass0", "−0.2 ± 0.4", "in it")),
        ({"masses": (9, 1.9)}, ("alarm", "mass1", "1.9 ± 0.4", "near")),
        ({"off": 2.1}, ("alarm", "off path", "2.1 ± 0.3", "off path")),
        ({"angle": 3.1}, ("alarm", "tilt", "3.1°", "tilted")),
        ({"left": -0.4}, ("alarm", "to aim", "−0.4", "beyond")),
    ],
)
def test_an_alarm_has_a_word_and_a_colour(found, row):
    shown = rows(tool_figures.html_of(moment(figures(**found)), SCENE, Alarms()))
    assert [one for one in shown if one[0]] == [row]
    assert ".alarm td" in moment_figures.STYLE
    assert row[3].upper() in tool_figures.line_of(moment(figures(**found)), SCENE, Alarms())
    wide = Alarms(path_mm=10, path_deg=20, mass_mm=0)
    assert bool([one for one in rows(tool_figures.html_of(moment(figures(**found)), SCENE, wide)) if one[0]]) == (
        row[3] in ("in it", "beyond")
    )


@pytest.mark.parametrize(
    "lost", [moment(None, "not found: camera 1: 2 of 3 circles", None), Moment(2, 0, None, "no frames of both cameras")]
)
def test_of_a_tool_that_is_not_seen_no_old_figure_stays_and_no_row_goes_away(lost):
    before, after = (rows(tool_figures.html_of(each, SCENE, Alarms())) for each in (moment(figures()), lost))
    assert [row[1] for row in after[2:]] == [row[1] for row in before[2:]]
    assert all(row[2:] == ("–", "–") for row in after[2:])
    assert after[1][0] == "alarm" and re.match("not seen: (camera 1: 2 of 3 circles|no frames of both cameras)$", after[1][1])
    assert tool_figures.line_of(lost, SCENE, Alarms()) == f"needle: {after[1][1]}"


def test_a_tool_whose_tip_is_not_calibrated_says_so():
    scene = StillScene(np.eye(4), masses=SCENE.masses, tools={"needle": None})
    assert rows(tool_figures.html_of(moment(), scene, Alarms()))[2:] == [(None, "tip", "–", "not calibrated")]
    assert tool_figures.line_of(moment(), scene, Alarms()) == "needle: tip not calibrated"


def test_a_shaft_of_an_unknown_direction_has_no_tilt():
    shown = rows(tool_figures.html_of(moment(figures(angle=None, crossing=None)), SCENE, Alarms()))
    assert (None, "tilt", "–", "no axis") in shown and (None, "crossing", "–", "–") in shown


def test_a_line_is_of_letters_that_any_program_reads():
    line = tool_figures.line_of(moment(figures()), SCENE, Alarms())
    assert line.isascii()
    assert line.startswith(
        "needle: mass0 12.3 +- 0.4, mass1 40.0 +- 0.4, off path 0.5 +- 0.3, tilt 1.0 deg, to aim 23.0, off image -3.1 "
    )


def test_texts_of_others_are_no_html():
    scene = StillScene(np.eye(4), masses={"<b>": BALL}, tools={"needle": TIP})
    shown = tool_figures.html_of(moment(None, "not found: <img src=x>", None), scene, Alarms())
    assert "<img" not in shown and "<b>" not in shown


@pytest.mark.parametrize("given", [{"path_mm": 0}, {"path_deg": 181}, {"mass_mm": -1}, {"mass_mm": float("nan")}])
def test_limits_without_a_sense_are_refused(given):
    with pytest.raises(ValidationError):
        Alarms(**given)


def test_tables_stand_among_the_pages_figures():
    shown = moment_figures.html_of(
        moment(figures()), SCENE.masses, tools=tool_figures.html_of(moment(figures()), SCENE, Alarms())
    )
    names = [row[1] for row in rows(shown)]
    assert names.index("needle") > names.index("mass") and names.index("B-scan") > names.index("crossing")
