"""Pattern sequences: do the files say what they mean, and do the patterns encode the coordinate?"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns

ROOT = Path(__file__).resolve().parents[3]
FILES = sorted((ROOT / "conf/patterns").glob("*.yaml"))
COUNTS = {"paper_surface": 9, "paper_calibration": 50, "gray_surface": 16, "multi_frequency": 20, "twelve_step_gray": 18}


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_files_load_and_explain_each_field(file):
    """Every sequence loads, has the images it announces, and each field of its first parts carries a comment."""
    text = file.read_text(encoding="utf-8")
    patterns = Patterns(**yaml.safe_load(text))
    assert patterns.count == COUNTS.get(file.stem, patterns.count)
    assert text.startswith("#")
    assert f"{patterns.count} images" in text.split("projector_size")[0]
    fields = [line for line in text.splitlines() if ":" in line and not line.startswith("#")]
    explained = {line.split(":")[0].strip(" -") for line in fields if "#" in line}
    assert {line.split(":")[0].strip(" -") for line in fields} - explained <= {"parts", "kind"}


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_images_are_the_profiles(file):
    patterns = Patterns(**yaml.safe_load(file.read_text(encoding="utf-8")))
    images = patterns.images()
    assert images.shape == (patterns.count, *patterns.projector_size[::-1])
    assert images.min() >= 0 and images.max() <= 1
    assert patterns.slices()[-1][1].stop == patterns.count


def test_fringes_carry_the_published_phase():
    """The rig authors' formula, phase = -atan2(sum I sin, sum I cos), gives back x = pitch phase / 2 pi + (1280 - 1) / 2."""
    fringes = Fringes(pitch=12, steps=8, first=1)
    profiles = fringes.profiles(1280).astype(float)
    s = fringes.shifts[:, None]
    phase = -np.arctan2((profiles * np.sin(s)).sum(axis=0), (profiles * np.cos(s)).sum(axis=0))
    x = 12 * phase / (2 * np.pi) + (1280 - 1) / 2
    off = (x - np.arange(1280)) / 12
    assert off == pytest.approx(np.rint(off), abs=1e-6)


def test_fringes_backwards_move_to_larger_x():
    """By a step of a period over the number of steps; they begin as the others do."""
    onwards, backwards = (Fringes(pitch=8, steps=4, backwards=way).profiles(64) for way in (None, True))
    assert np.allclose(backwards[0], onwards[0])
    for k in range(3):
        assert np.allclose(backwards[k + 1, 2:], backwards[k, :-2], atol=1e-6)
        assert np.allclose(onwards[k + 1, :-2], onwards[k, 2:], atol=1e-6)


@pytest.mark.parametrize(("pitch", "origin"), [(18, 640.0), (18, 639.5), (16, 639.5), (12, 639.5)])
def test_binary_fringes_light_half_of_each_period(pitch, origin):
    """Whole pixels, as many lit as dark in each period and each image, also where an edge falls on a pixel's centre."""
    profiles = Fringes(pitch=pitch, steps=pitch, origin=origin, waveform="binary").profiles(80 * pitch)
    assert (profiles.reshape(pitch, 80, pitch).sum(axis=2) == pitch // 2).all()


def test_calibration_fringes_are_unbiased():
    """The fundamental of the calibration's binary patterns has the phase of the coordinate, to a thousandth of a pixel."""
    patterns = Patterns(**yaml.safe_load((ROOT / "conf/patterns/paper_calibration.yaml").read_text(encoding="utf-8")))
    for part in patterns.parts:
        if isinstance(part, Fringes):
            length = patterns.length(part.axis)
            profiles, s = part.profiles(length).astype(float), part.shifts[:, None]
            phase = np.arctan2(-(profiles * np.sin(s)).sum(axis=0), (profiles * np.cos(s)).sum(axis=0))
            off = (part.zero(length) + part.pitch * phase / (2 * np.pi) - np.arange(length)) / part.pitch
            assert off == pytest.approx(np.rint(off), abs=1e-3 / part.pitch)


def test_neighbouring_periods_differ_in_one_bit():
    """A Gray code: along the axis, one image at most changes from one pixel to the next, the complementary bit included."""
    code = GrayCode(pitch=12, bits=7, complementary=True)
    changes = np.abs(np.diff(code.profiles(1280), axis=1)).sum(axis=0)
    assert changes.max() == 1
    assert np.count_nonzero(changes) == pytest.approx(1280 / 6, abs=1)


def test_inverted_images_are_the_inverse():
    profiles = GrayCode(pitch=12, bits=4, inverted=True).profiles(200)
    assert (profiles[0::2] + profiles[1::2] == 1).all()


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_the_fringes_add_up_to_even_light(file):
    patterns = Patterns(**yaml.safe_load(file.read_text(encoding="utf-8")))
    assert np.ptp(np.tensordot(patterns.even_light, patterns.images(), axes=1)) < 1e-5


@pytest.mark.parametrize("width", [1, 2, 3])
def test_line_is_where_it_says(width):
    """Its light is its width, its centroid its position."""
    line = CentreLine(width=width)
    profile = line.profiles(1280)[0].astype(float)
    assert profile.sum() == pytest.approx(width)
    assert (profile * np.arange(1280)).sum() / profile.sum() == pytest.approx(639.5)


@pytest.mark.parametrize(
    ("unwrap", "parts", "message"),
    [
        ("gray", [{"kind": "fringes", "pitch": 12, "steps": 8}], "one part of that kind, found 0"),
        ("heterodyne", [{"kind": "fringes", "pitch": 12, "steps": 8}], "two or more sets"),
        ("heterodyne", [{"kind": "gray", "pitch": 1, "bits": 11, "inverted": True}], "at least one set of fringes, found none"),
        ("gray", [{"kind": "uniform"}], "at least one set of fringes or a Gray code, found none"),
        ("gray", [{"kind": "gray", "pitch": 12, "bits": 7}], "of level 0 and 1, whose middle is the threshold, found none"),
        ("gray", [{"kind": "uniform"}, {"kind": "gray", "pitch": 12, "bits": 7}], "the threshold, found level 1"),
        ("gray", [{"kind": "gray", "pitch": 1, "bits": 11, "inverted": True}] * 2, "expects one part of that kind, found 2"),
        ("gray", [{"kind": "gray", "pitch": 1, "bits": 11, "complementary": True}], "expected 2 px or more with the compl"),
        ("gray", [{"kind": "fringes", "pitch": 12, "steps": 8}, {"kind": "gray", "pitch": 18, "bits": 7}], "one pitch"),
        ("heterodyne", [{"kind": "fringes", "pitch": 12, "steps": 8}] * 2, "expects different pitches, found 12, 12 px"),
        ("centre_line", [{"kind": "fringes", "pitch": np.inf, "steps": 8}], "finite number"),
        ("centre_line", [{"kind": "fringes", "pitch": 12, "steps": 8, "origin": np.nan}], "finite number"),
        ("centre_line", [{"kind": "fringes", "pitch": 12, "steps": 8, "colour": 1}], "Extra inputs"),
    ],
)
def test_sequences_that_cannot_be_unwrapped_are_refused(unwrap, parts, message):
    with pytest.raises(ValidationError, match=message):
        Patterns(projector_size=(1280, 800), unwrap=unwrap, parts=parts)


@pytest.mark.parametrize(
    ("bits", "start", "covers"),
    [
        (5, None, "447.5 to 831.5"),
        (7, 12.0, "12 to 1548"),
        (7, -300.0, "-300 to 1236"),
        (7, 0.0, None),
        (7, -0.5, None),
        (7, -200, None),
    ],
)
def test_a_code_that_misses_part_of_the_axis_is_refused(bits, start, covers):
    """Beyond its range the code repeats itself mirrored: it would be decoded, wrongly."""

    def sequence():
        return Patterns(
            projector_size=(1280, 800),
            unwrap="gray",
            parts=(Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=bits, start=start)),
        )

    if covers is None:
        assert sequence().count == 8 + bits
        return
    with pytest.raises(ValidationError, match=f"parts: Gray code of columns covers {covers} px, expected 0 to 1279"):
        sequence()


@pytest.mark.parametrize(
    ("pitch", "origin", "off"), [(18, None, True), (18, 640, False), (16, None, False), (16, 640, True), (9, None, False)]
)
def test_binary_fringes_half_a_pixel_off_are_refused(pitch, origin, off):
    """An odd number of lit pixels has a pixel in its middle, an even number a border."""

    def sequence():
        fringes = Fringes(pitch=pitch, steps=pitch, origin=origin, waveform="binary")
        return Patterns(projector_size=(1280, 800), unwrap="centre_line", parts=(CentreLine(), fringes))

    if not off:
        assert sequence().count == pitch + 1
        return
    with pytest.raises(ValidationError, match=r"binary fringes of columns lie [+-]0\.50 px off"):
        sequence()


@pytest.mark.parametrize("size", [(-5, 0), (7, 800), (1280, 20001)])
def test_projectors_of_impossible_size_are_refused(size):
    with pytest.raises(ValidationError, match="than or equal"):
        Patterns(projector_size=size, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=8)))
