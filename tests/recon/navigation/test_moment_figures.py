"""The page's figures: each is there by its name, in its place whatever it is, and no text of others is HTML."""

import re
from dataclasses import replace

import numpy as np

from recon.geometry import rigid
from recon.navigation.mass_distances import MassDistance
from recon.navigation.moment_figures import html_of
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import Latency, Moment
from recon.navigation.seen_so_far import SeenSoFar

POSE = rigid.transform(np.eye(3), [0, 0, 640])
SCAN = PlacedScan(np.zeros((120, 80), np.uint8), 1, 10**9, np.eye(4))
MASSES = ("mass0", "mass1", "mass2")
NEAR = (
    MassDistance("mass0", -8.64, 0.5, np.zeros((1, 2, 3)), True),
    MassDistance("mass1", -3.0, 0.5, np.zeros((1, 2, 3)), False),
    MassDistance("mass2", 12.34, -20, np.empty((0, 2, 3)), False),
)


def rows(html):
    """Cells of each row of the tables, as text."""
    return [re.findall(r">([^<]*)</t[hd]>", row) for row in re.findall("<tr.*?</tr>", html)]


def test_each_figure_stands_under_its_name():
    found = rows(html_of(Moment(4, 0, POSE, "target predicted", SCAN, NEAR, (), Latency(31.4, 58.0, 24.9)), MASSES))
    assert found == [
        ["mass", "plane, mm", "cut"],
        ["mass0", "−8.6", "in image"],
        ["mass1", "−3.0", "beside it"],
        ["mass2", "12.3", "–"],
        ["B-scan", "in place"],
        ["Latency", "31 ms, 99 % below 58 ms"],
        ["Poses", "25 a second"],
    ]


def test_the_share_that_was_seen_stands_last():
    given = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    seen = SeenSoFar(0.426, 212_400.0, *given, source="by assumed coefficients")
    told = "43 % of 212 cm³, by assumed coefficients"
    assert rows(html_of(Moment(4, 0, POSE, "target predicted", seen=seen), ()))[-1] == ["Seen", told]
    known = replace(seen, uneven_db=3.42, source="by coefficients fitted to 900 trials")
    told = "43 % of 212 cm³, by coefficients fitted to 900 trials; tissue uneven by 3.4 dB"
    assert rows(html_of(Moment(4, 0, POSE, "target predicted", seen=known), ()))[-1] == ["Seen", told]


def test_without_a_b_scan_no_row_goes_away():
    """What is beneath doesn't jump, and no distance of before stands there."""
    lost = html_of(Moment(5, 0, None, "target not found: camera 1: 2 of 3 circles"), MASSES)
    assert "<b>Not tracking:</b> target not found: camera 1: 2 of 3 circles" in lost
    assert rows(lost)[1:5] == [*([name, "–", "–"] for name in MASSES), ["B-scan", "none in place"]]


def test_texts_of_others_are_no_html():
    """Names of files, and what devices in the network say."""
    shown = html_of(Moment(5, 0, None, "no frames", troubles=("us: found <img src=x onerror=alert(1)>",)), ("<script>",))
    assert "<img" not in shown and "<script" not in shown and "us: found &lt;img" in shown
