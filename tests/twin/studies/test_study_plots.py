"""Plots show medians and ranges of what they say, over axes that fit."""

import numpy as np
import pytest

from twin.studies import study_plots

NAN = float("nan")


def table(*rows):
    return [dict(zip(("pitch", "how", "seed", "error_mm", "limit_mm"), row, strict=True)) for row in rows]


TABLE = table(
    (12, "a", 0, 3.0, 1.0), (12, "a", 1, 1.0, 1.0), (12, "a", 2, 2.0, 1.0), (12, "b", 0, 9.0, 3.0),
    (6, "a", 0, 5.0, 0.5), (6, "a", 1, NAN, 0.5), (6, "a", 2, 7.0, 0.5), (6, "b", 0, NAN, 0.5),
)  # fmt: skip


def test_courses_are_medians_between_the_least_and_the_greatest():
    """Over the factor's values in their order; figures that are missing don't count, and none at all is no point."""
    (found,) = study_plots.courses(TABLE, "error_mm", "pitch", None)
    assert (found.middle.tolist(), found.low.tolist(), found.high.tolist()) == ([6.0, 2.5], [5.0, 1.0], [7.0, 9.0])
    first, second = study_plots.courses(TABLE, "error_mm", "pitch", "how")
    assert (first.label, second.label) == ("how: a", "how: b")
    assert first.middle.tolist() == [6.0, 2.0] and np.isnan(second.middle[0]) and second.high[1] == 9.0


def test_a_plot_has_a_line_a_value_of_the_other_factor_and_what_each_is_held_against():
    """Dashed, in the colour of its line, with one entry of the legend under its name."""
    (axes,) = study_plots.draw(TABLE, "error_mm", "pitch", ["pitch", "how"], "limit_mm", "noise alone").axes
    full, dashed = ([line for line in axes.get_lines() if line.get_linestyle() == style] for style in ("-", "--"))
    assert [line.get_label() for line in full] == ["how: a", "how: b"] and full[0].get_xydata().tolist() == [[6, 6], [12, 2]]
    assert [line.get_xydata().tolist() for line in dashed] == [[[6, 0.5], [12, 1]], [[6, 0.5], [12, 3]]]
    assert [line.get_color() for line in dashed] == [line.get_color() for line in full] == ["C0", "C1"]
    assert [entry.get_text() for entry in axes.get_legend().get_texts()] == ["how: a", "how: b", "noise alone"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("pitch", "error, mm")
    (alone,) = study_plots.draw(TABLE, "error_mm", "pitch", ["pitch"], "").axes
    assert [line.get_label() for line in alone.get_lines()] == ["median and range"]
    (held,) = study_plots.draw(TABLE, "error_mm", "pitch", ["pitch"], "limit_mm").axes
    assert [(line.get_label(), line.get_linestyle()) for line in held.get_lines()] == [
        ("median and range", "-"),
        ("closed form", "--"),
    ]


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ([1, 2, 4, 8], "log"),
        ([2, 4, 6, 8], "linear"),
        ([0, 1, 10, 100], "linear"),
        ([4, 5, 6, 8, 12, 18], "log"),
        ([3, 9], "linear"),
    ],
)
def test_an_axis_is_logarithmic_where_steps_grow(values, scale):
    """Not through zero; two values have one step."""
    (axes,) = study_plots.draw(table(*((value, "", 0, 1.0, NAN) for value in values)), "error_mm", "pitch", ["pitch"], "").axes
    assert axes.get_xscale() == scale
    assert scale == "linear" or axes.get_xticks().tolist() == values


@pytest.mark.parametrize(("errors", "scale", "least"), [((1, 20), "log", None), ((1, 3), "linear", 0), ((-1, 3), "linear", None)])
def test_heights_begin_at_zero_or_are_logarithmic(errors, scale, least):
    rows = table(*((k, "", 0, float(error), NAN) for k, error in enumerate(errors)))
    (axes,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "").axes
    assert axes.get_yscale() == scale
    assert axes.get_ylim()[0] == 0 if least == 0 else axes.get_ylim()[0] != 0


def test_words_are_shown_in_the_order_in_which_they_come():
    (axes,) = study_plots.draw(TABLE, "error_mm", "how", ["how"], "").axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["a", "b"]
    (line,) = axes.get_lines()
    assert line.get_ydata().tolist() == [3.0, 9.0]


def test_there_is_no_line_between_words():
    """Nor an area: markers, with bars from the least to the greatest, and strokes of what they are held against."""
    (axes,) = study_plots.draw(TABLE, "error_mm", "how", ["how"], "limit_mm", "noise alone").axes
    assert [(line.get_linestyle(), line.get_marker()) for line in axes.get_lines()] == [("None", "o"), ("None", "_")]
    (bars,) = axes.collections
    assert [segment[:, 1].tolist() for segment in bars.get_segments()] == [[1.0, 7.0], [9.0, 9.0]]
    (axes,) = study_plots.draw(TABLE, "error_mm", "how", ["how", "pitch"], "limit_mm").axes
    places = [line.get_xdata()[0] for line in axes.get_lines()]
    assert places[0] < 0 < places[1] and places[:2] == places[2:]  # of pitch 6 and 12, beside each other
    (axes,) = study_plots.draw(TABLE, "error_mm", "pitch", ["pitch"], "").axes
    assert axes.get_lines()[0].get_linestyle() == "-"


def test_no_marker_is_cut_off():
    """At the edges of the axes, as of a figure of zero."""
    rows = table((6, "a", 0, 0.0, 1.0), (12, "b", 0, 3.0, 1.0))
    for field in ("pitch", "how"):
        (axes,) = study_plots.draw(rows, "error_mm", field, [field], "limit_mm").axes
        assert not axes.get_lines()[0].get_clip_on()
    assert axes.get_xlim() == (-0.5, 1.5)


def test_a_single_point_stands_clear_of_the_edges():
    """With what it is held against, and with its value below it; likewise values that are nearly the same."""
    (axes,) = study_plots.draw(table((6, "a", 0, 0.3, 0.2)), "error_mm", "pitch", ["pitch"], "limit_mm").axes
    point, held = axes.get_lines()
    assert axes.get_ylim()[0] == 0 and axes.get_ylim()[1] >= 0.33
    assert held.get_xydata().tolist() == [[0, 0.2]] and held.get_marker() == "_" and point.get_xydata().tolist() == [[0, 0.3]]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["6"]
    alike = table((6, "a", 0, 0.3, NAN), (12, "a", 0, 0.301, NAN), (18, "a", 0, 0.3, NAN))
    (axes,) = study_plots.draw(alike, "error_mm", "pitch", ["pitch"], "").axes
    assert axes.get_ylim()[0] == 0 and axes.get_ylim()[1] >= 0.33


def test_one_seed_has_no_median():
    rows = table((6, "a", 0, 2.0, 1.0), (12, "a", 0, 3.0, 1.0))
    (axes,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "").axes
    assert [line.get_label() for line in axes.get_lines()] == ["a trial"]


@pytest.mark.parametrize(("reported", "heights"), [((0.72, 0.72), [0.72]), ((10.0, 13.0), [10.0, 13.0])])
def test_what_the_paper_reports_is_a_dashed_line(reported, heights):
    """Two for a range, one entry of the legend; it is within the axes."""
    name = study_plots.Name("planes, RMS, ours, mm", reported)
    for field in ("pitch", "how"):
        (axes,) = study_plots.draw(TABLE, "error_mm", field, [field], "", "", name).axes
        lines = [line for line in axes.get_lines() if line.get_linestyle() == "--"]
        assert [line.get_ydata()[0] for line in lines] == heights
        assert [text.get_text() for text in axes.get_legend().get_texts()].count("paper reported") == 1
        assert axes.get_ylabel() == "planes, RMS, ours, mm" and axes.get_ylim()[1] >= max(heights)


def test_an_error_of_both_signs_is_compared_by_its_size():
    """With a standard deviation or what the paper reports; alone it keeps its sign."""
    rows = table((6, "a", 0, -2.0, 1.0), (12, "a", 0, 3.0, 1.0), (18, "a", 0, NAN, 1.0))
    (held,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "limit_mm").axes
    assert held.get_lines()[0].get_ydata().tolist()[:2] == [2.0, 3.0] and held.get_ylabel() == "size of error, mm"
    (alone,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "").axes
    assert alone.get_lines()[0].get_ydata().tolist()[:2] == [-2.0, 3.0] and alone.get_ylabel() == "error, mm"
    (positive,) = study_plots.draw(rows[1:], "error_mm", "pitch", ["pitch"], "limit_mm").axes
    assert positive.get_ylabel() == "error, mm"


def test_many_values_are_a_cloud():
    """Of a space-filling design: a point a trial, and what it is held against."""
    rows = table(*((k + 0.5, "", 0, float(k), k / 2) for k in range(30)))
    (axes,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "limit_mm", "noise alone").axes
    errors, limits = axes.get_lines()
    assert len(errors.get_xdata()) == len(limits.get_xdata()) == 30 and errors.get_linestyle() == "None"
    assert limits.get_label() == "noise alone" and limits.get_ydata()[4] == 2


def test_a_figure_that_no_trial_gave_is_drawn_empty():
    rows = table((6, "a", 0, NAN, NAN), (12, "a", 0, NAN, NAN))
    (axes,) = study_plots.draw(rows, "error_mm", "pitch", ["pitch"], "limit_mm").axes
    assert np.isnan(axes.get_lines()[0].get_ydata()).all()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("plane_rms_mm", "plane RMS, mm"),
        ("patterns.parts.fringes.pitch", "pitch"),
        ("rig.cam1.gain+rig.cam2.lens.blur_px", "gain and blur, px"),
        ("shooting.exposure_s", "exposure, s"),
        ("scale_sigma_ppm", "scale sigma, ppm"),
        ("coverage", "coverage"),
        ("images", "images"),
        ("rig.projector.radiant_flux_w", "radiant flux, W"),
        ("noise.speed_mm_s", "speed, mm/s"),
        ("brightness_dn", "brightness, DN"),
        ("cr1_mean_ours_mm", "CR1 mean, ours, mm"),
        ("tumours_inside_paper", "tumours inside, paper's method"),
        ("tumour_volume_error_ours_percent", "tumour volume error, ours, %"),
    ],
)
def test_names_are_words_with_their_unit(name, expected):
    assert study_plots.words(name) == expected


def test_numbers_come_in_their_order_and_words_as_they_come():
    assert study_plots.distinct([3, 1, 3, 2]) == [1, 2, 3] and study_plots.distinct(["b", "a", "b"]) == ["b", "a"]


def test_the_other_factor_has_few_values():
    rows = [{"a": k, "b": k % 2, "c": 1, "d": k % 3} for k in range(12)]
    assert study_plots.other_factor(rows, "a", ["a", "c", "b", "d"]) == "b"
    assert study_plots.other_factor(rows, "b", ["a", "b", "c"]) is None
