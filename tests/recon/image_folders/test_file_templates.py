"""Names of images, read by templates."""

import pytest

from recon.errors import InputError
from recon.image_folders import file_templates
from recon.image_folders.file_templates import CAMERAS, Words

WORDS = Words(CAMERAS, ("lit",))


def parts(path: str, *templates: str, words: Words = WORDS) -> tuple[str, str, str] | None:
    """Camera, pose and image; None if no template fits."""
    names = file_templates.read([path], templates, words)
    return (names[0].camera, names[0].pose, names[0].image) if names else None


@pytest.mark.parametrize(
    ("path", "template", "expected"),
    [
        ("Left/pose 3/a_7.PNG", "<camera>/<pose>/<image>", ("cam1", "pose 3", "a_7")),
        ("P1_2_07.bmp", "<pose>_<image>", ("cam1", "P1_2", "07")),
        ("P1_lit.bmp", "<pose>_<image>", ("cam1", "P1", "lit")),
        ("P1_mask.bmp", "<pose>_<image>", None),
        ("right07.tif", "<camera><pose>", ("cam2", "07", "")),
        ("up/7.png", "<camera>/<pose>", None),
        ("x-9/shot(7).png", "*/shot(<image>)", ("cam1", "", "7")),
        ("7.png", "<image>.bmp", None),
        ("7.preview.png", "<pose>_<image>", None),
    ],
)
def test_parts_of_a_name(path, template, expected):
    """Signs in a template stand for themselves; a number is one only where other text is beside it."""
    assert parts(path, template) == expected


def test_the_first_template_that_fits():
    assert parts("a/7.png", "<camera>/<pose>", "<pose>/<image>", "<image>/<pose>") == ("cam1", "a", "7")


def test_words_of_ones_own():
    assert parts("C.1_7.png", "<camera>_<image>", words=Words({"c.0": "cam1", "c.1": "cam2"}, ())) == ("cam2", "", "7")


def test_usual_templates_are_templates():
    for template in {*file_templates.usual(board=True), *file_templates.usual(board=False)}:
        file_templates.check(template)


@pytest.mark.parametrize("template", ["image.png", "<pose>/<pose>", "<number>"])
def test_wrong_templates_are_refused(template):
    with pytest.raises(InputError, match="each at most once"):
        file_templates.check(template)
