"""From a folder of images to which camera took each and in which pose, by the names and the numbers of the images alone."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon.capture.image_formats import SUFFIXES
from recon.capture.images import natural_key
from recon.errors import InputError, short
from recon.image_folders import file_templates
from recon.image_folders.file_templates import FIRST, Name, Words

LIKE_CAMERAS = re.compile(r"(?<![a-z0-9])(cam(?:era)?[ _-]?\d+|left|right|[lr])(?![a-z0-9])", re.IGNORECASE)

NUMBER = re.compile(r"\d+")


@dataclass(frozen=True)
class View:
    """Images of one pose by one camera; paths below the folder."""

    lit: tuple[str, ...]  # evenly lit, or the only one
    sequence: tuple[str, ...]  # under the patterns, in natural order

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        return self.lit + self.sequence


@dataclass(frozen=True)
class Expected:
    """What a folder is expected to hold."""

    board: bool  # poses of a board, or one surface
    count: int  # of the patterns; 0 if there are none
    source: str  # of the patterns, for messages

    @property
    def example(self) -> str:
        """A template, for messages."""
        return "'<camera>/<pose>/<image>.png'" if self.board else "'<camera>/<image>.png'"


@dataclass(frozen=True)
class Reading:
    """A folder's images as templates read them."""

    templates: tuple[str, ...]
    views: Mapping[tuple[str, str], View]  # (pose, camera), in natural order

    @property
    def poses(self) -> tuple[str, ...]:
        """Names of the poses."""
        return tuple(dict.fromkeys(pose for pose, _ in self.views))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(sorted({camera for _, camera in self.views}))

    def paths(self, camera: str) -> list[str]:
        """All images of a camera."""
        return [path for (_, own), view in self.views.items() if own == camera for path in view.paths]

    def unseen(self, camera: str) -> list[str]:
        """Poses of which a camera has no image."""
        return [pose for pose in self.poses if (pose, camera) not in self.views]

    @property
    def is_shared(self) -> bool:
        """Whether some pose was seen by several cameras, or there is one camera alone."""
        return len(self.cameras) < 2 or len(self.poses) < len(self.views)

    def without_sequence(self, camera: str) -> list[str]:
        """Poses that a camera saw lit alone; none of a camera that saw the patterns in no pose."""
        seen = {pose: view for (pose, own), view in self.views.items() if own == camera}
        return [pose for pose, view in seen.items() if not view.sequence and any(other.sequence for other in seen.values())]


def image_paths(folder: Path) -> list[str]:
    """All images below a folder, with slashes, in natural order; hidden ones don't count.

    Raises
    ------
    InputError
        If there is no such folder, or no image in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of images, found {'a file' if folder.exists() else 'nothing'}")
    relative = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    paths = [path.as_posix() for path in relative if not any(part.startswith(".") for part in path.parts)]
    if strange := next((path for path in paths if path.encode("utf-8", "replace").decode("utf-8") != path), None):
        raise InputError(f"{folder}: expected names of images in UTF-8, found {short(strange)}: rename it")
    if not paths:
        raise InputError(f"{folder}: expected images ({', '.join(SUFFIXES)}), found none")
    return sorted(paths, key=_natural)


def find(folder: Path, paths: Sequence[str], expected: Expected, words: Words) -> Reading:
    """Read a folder by the usual template under which all images have a place and their numbers are right.

    Parameters
    ----------
    paths : as of `image_paths`

    Raises
    ------
    InputError
        If there is none, or there are several that differ.
    """
    usual = file_templates.usual(expected.board)
    by_template = {template: file_templates.read(paths, (template,), words) for template in usual}
    whole = [_reading((template,), names, words) for template, names in by_template.items() if len(names) == len(paths)]
    readings = [reading for reading in whole if "<camera>" in reading.templates[0]]
    if not readings:
        _refuse_hidden_cameras(folder, paths, expected, words)
        readings = whole
    if not readings:
        raise InputError(f"{folder}: {_strange(paths, by_template, expected)}")
    readings = [reading for reading in readings if reading.is_shared] or readings
    fitting = {frozenset(reading.views.values()): reading for reading in reversed(readings) if not _faults(reading, expected)}
    if len(fitting) > 1:
        several = " or ".join(f"'{reading.templates[0]}'" for reading in reversed(fitting.values()))
        raise InputError(f"{folder}: expected names of one meaning, found {paths[0]}, which may be {several}; give one as files=")
    nearest = min(readings, key=lambda reading: len(_faults(reading, expected)) / len(reading.views))
    _refuse(folder, nearest, expected)
    if not nearest.is_shared:
        examples = ", ".join(
            f"{camera} in {next(pose for pose, own in nearest.views if own == camera)}" for camera in nearest.cameras
        )
        how = f"give files={expected.example} with <pose> where both have the same text"
        raise InputError(
            f"{folder}: expected poses that {' and '.join(nearest.cameras)} saw together, found none, but {examples}, read as "
            f"{' or '.join(nearest.templates)}; {how}"
        )
    return nearest


def by_templates(folder: Path, paths: Sequence[str], expected: Expected, words: Words, templates: Sequence[str]) -> Reading:
    """Read a folder by given templates; images that fit none don't count. Parameters as of `find`.

    Raises
    ------
    InputError
        If a template is wrong, none fits an image, or the numbers of images are wrong.
    """
    for template in templates:
        file_templates.check(template)
        if expected.board != ("<pose>" in template):
            wanted = "<pose>, as a board has several" if expected.board else "no <pose>, as there is no board"
            raise InputError(f"files: expected {wanted}, found {template}")
        if not expected.board and "<image>" not in template:
            raise InputError(f"files: expected <image>, by which a surface's images are put in order, found {template}")
    names = file_templates.read(paths, templates, words)
    if not names:
        named = f", with cameras {', '.join(words.cameras)}" if any("<camera>" in template for template in templates) else ""
        raise InputError(f"files: expected names like {' or '.join(templates)}{named}, found {folder / paths[0]}")
    reading = _reading(tuple(templates), names, words)
    _refuse(folder, reading, expected)
    return reading


def _reading(templates: tuple[str, ...], names: Sequence[Name], words: Words) -> Reading:
    """Images by pose and camera, all in natural order."""
    views: dict[tuple[str, str], list[Name]] = {}
    for name in sorted(names, key=lambda name: (_natural(name.pose), name.camera, _natural(name.image), name.path)):
        views.setdefault((name.pose, name.camera), []).append(name)
    return _paired(Reading(templates, {place: _view(images, words) for place, images in views.items()}))


def _paired(reading: Reading) -> Reading:
    """The same with poses by their numbers alone, where cameras have other words for them, as `left01` and `right01`."""
    if reading.is_shared:
        return reading
    places = {place: NUMBER.findall(place[0]) for place in reading.views}
    words = {(camera, NUMBER.sub("#", pose)) for pose, camera in places}
    numbered = {("_".join(numbers), camera): reading.views[pose, camera] for (pose, camera), numbers in places.items() if numbers}
    if len(words) > len(reading.cameras) or len(numbered) < len(places):
        return reading
    paired = Reading(reading.templates, dict(sorted(numbered.items(), key=lambda item: (_natural(item[0][0]), item[0][1]))))
    return paired if paired.is_shared else reading


def _view(names: Sequence[Name], words: Words) -> View:
    """Images of a pose by a camera. An only one counts as lit, and so does one without a number."""
    even = [_natural(word.lower()) for word in words.lit]
    lit = [name for name in names if not name.image or len(names) == 1 or _natural(name.image.lower()) in even]
    return View(tuple(name.path for name in lit), tuple(name.path for name in names if name not in lit))


def _faults(reading: Reading, expected: Expected) -> dict[tuple[str, str], str]:
    """Views with another number of images than expected, and what was expected and found."""
    if expected.count and not any(view.sequence for (_, camera), view in reading.views.items() if camera == FIRST):
        text = f"expected {expected.count} images of {FIRST}, one a pattern of {expected.source}, found one"
        return dict.fromkeys(reading.views, text)
    faults = ((place, _fault(view, expected)) for place, view in reading.views.items())
    return {place: fault for place, fault in faults if fault is not None}


def _fault(view: View, expected: Expected) -> str | None:
    """What is wrong with the number of images of a view."""
    if not expected.board:
        return None if len(view.paths) == expected.count else _miscounted(len(view.paths), expected)
    if not expected.count and view.sequence:
        return f"expected one image, as there are no patterns, found {len(view.paths)}"
    if len(view.lit) > 1:
        return f"expected one lit image, found {', '.join(view.lit[:2])}"
    return None if len(view.sequence) in (0, expected.count) else _miscounted(len(view.sequence), expected)


def _miscounted(found: int, expected: Expected) -> str:
    return f"expected {expected.count} images, one a pattern of {expected.source}, found {found}"


def _refuse(folder: Path, reading: Reading, expected: Expected) -> None:
    """Refuse a reading with wrong numbers of images, by the first view that has one, or without camera 1."""
    if FIRST not in reading.cameras:
        raise InputError(
            f"{folder}: expected images of {FIRST}, found {', '.join(reading.cameras)}; give cameras={{{FIRST}: ...}}"
        )
    faults = _faults(reading, expected)
    if faults:
        (pose, camera), fault = next(iter(faults.items()))
        alike = len(faults) == len(reading.views) and len(set(faults.values())) == 1
        where = f"of {camera}"
        if expected.board:
            where = f"in each of {len(reading.poses)} poses" if alike else f"of {camera} in pose {pose}"
        how, cause = " or ".join(reading.templates), _cause(expected, alike)
        raise InputError(f"{folder}: {fault} {where}, read as {how}: {cause} Other names are given by files={expected.example}")


def _cause(expected: Expected, alike: bool) -> str:
    """The likely cause of a wrong number of images, alike in all views or not."""
    if not expected.count:
        return "give patterns=NAME or FILE."
    if not alike:
        return "is an image missing, or one too many?"
    if expected.board:
        return "are the patterns others, or is a lit image among them, which lit=[...] should name?"
    return "are the patterns others, or is this a board, in need of board={...}?"


def _refuse_hidden_cameras(folder: Path, paths: Sequence[str], expected: Expected, words: Words) -> None:
    """Refuse names that seem to have cameras by words that aren't known, or that some lack."""
    found = list(dict.fromkeys(word for path in paths for word in LIKE_CAMERAS.findall(path)))
    if found:
        fields = ", ".join(f"cam{number}: {word}" for number, word in enumerate(found[:2], start=1))
        raise InputError(
            f"{folder}: expected cameras named {', '.join(words.cameras)} in the names of all images or of none, "
            f"found {', '.join(found[:4])}; give cameras={{{fields}}}, or files={expected.example}"
        )


def _strange(paths: Sequence[str], by_template: Mapping[str, Sequence[Name]], expected: Expected) -> str:
    """What is strange with names that no usual template reads, in words."""
    nearest = max(by_template, key=lambda template: len(by_template[template]))
    read = {name.path for name in by_template[nearest]}
    if 2 * len(read) < len(paths):
        how = "give files='...', with <camera>, <pose> and <image> in their places"
        return f"expected names like {expected.example}, found {paths[0]}; {how}"
    other = next(path for path in paths if path not in read)
    return f"expected names alike, {nearest}, found {other} among them; files='...' leaves out what it doesn't fit"


def _natural(path: str) -> tuple[list[tuple[int, str]], ...]:
    """Key that sorts paths as people do."""
    return tuple(natural_key(Path(part)) for part in path.split("/"))
