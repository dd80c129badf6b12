"""Draw a calibration board or a body's target for a printer, true to scale, or the card by which a rig is recorded: a PDF.

`part=board` draws the board of the field `board`, of any kind that `calibrate-optics` finds; `part=target` draws the rings of
`rig.target`, or of another `body` of the rig. `family=3` draws three targets, a page each, of which none is taken for another,
and prints the lines that describe all but the first as bodies of a rig. Around the card to cut out are cut marks, a ruler of
100 mm along each axis, and its lengths in small print. `part=protocol` is a page for whoever records a rig that `identify` is to
measure: six steps, with what is to be seen at each. Writes the file `out`; one that is there is replaced. Takes a second.

Print boards and targets at 100 %, measure both rulers, and where they aren't 100.0 mm long, give the lengths as they are on paper
wherever board or target are described: docs/calibration.md says how.

    sonotwin print part=board out=board.pdf
    sonotwin print part=board board='{kind: charuco, columns: 8, rows: 11, square_mm: 20, marker_mm: 15}' paper=a4 out=charuco.pdf
    sonotwin print part=board board='{kind: aprilgrid, columns: 6, rows: 6, tag_mm: 24}' paper=a4 out=aprilgrid.pdf
    sonotwin print part=target out=target.pdf
    sonotwin print part=target rig=three_bodies body=needle out=needle.pdf
    sonotwin print part=target family=3 rig=three_bodies out=targets.pdf
    sonotwin print part=protocol paper=letter out=protocol.pdf
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from recon.artwork import board_drawing, paper_sheet, protocol_card, target_drawing
from recon.artwork.paper_sheet import PAPERS, Card, Page, Sheet, Size
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.errors import InputError, did_you_mean
from recon.files import atomic
from recon.model import target_family
from recon.model.boards import Board, Discs
from recon.model.rig import PROBE, Rig, Target, parted_mm
from recon.registry import Choice
from sonotwin.verbs.describe import design

USUAL = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9)  # as conf/scene/board.yaml
LEAST_SCALE = 0.1  # of a board, that is offered where it doesn't fit

Paper = Literal["a4", "letter", "a3", "tabloid", "a2", "a1", "a0"]
Millimetres = Annotated[float, Field(gt=0, le=5000)]


class Config(BaseModel):
    """Fields of `sonotwin print`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's lengths and the size of its board"""
    part: Literal["board", "target", "protocol"]
    """board, for cameras and projector; target, for the probe; or protocol, what to record of a rig in 20 minutes"""
    out: Path
    """the PDF to write"""
    body: str = PROBE
    """with part=target: probe, or a name in rig.bodies"""
    family: Annotated[int, Field(ge=2, le=target_family.MOST)] | None = None
    """with part=target: draw so many targets that can be told apart, that of `body` the first"""
    board: dict[str, Any] | None = None
    """kind, columns, rows and lengths in mm, as of `describe`; null: 11 rows of 4 discs of 9 mm, 15 mm apart"""
    paper: Paper | tuple[Millimetres, Millimetres] = "a4"
    """a4, letter, a3, tabloid, a2, a1, a0, or [width,height] in mm; turned where that fits better"""
    margin_mm: Annotated[float, Field(ge=0, le=50)] = 5.0
    """mm, border on which the printer doesn't print; ours: few laser printers need more"""

    @model_validator(mode="after")
    def _board_to_draw(self) -> "Config":
        if self.part != "board" and self.board is not None:
            drawn = "draws rig.target" if self.part == "target" else "draws none"
            raise ValueError(f"board: expected none with part={self.part}, which {drawn}")
        for name, value in (("body", self.body if self.body != PROBE else None), ("family", self.family)):
            if self.part != "target" and value is not None:
                raise ValueError(f"{name}: expected none with part={self.part}, found {value}")
        if self.body not in self.rig.targets:
            raise ValueError(f"body: expected one of {', '.join(self.rig.targets)}, found {self.body}{near(self.body, self.rig)}")
        return self


def run(config: Config) -> None:
    """Draw, and say how to go on.

    Raises
    ------
    InputError
        If the design is wrong, the card doesn't fit on the paper, or `out` is no PDF or can't be written.
    """
    if config.out.suffix.lower() != ".pdf":
        raise InputError(f"out: expected the name of a PDF, such as {config.part}.pdf, found {config.out}")
    if blocking := next((each for each in config.out.parents if each.exists() and not each.is_dir()), None):
        raise InputError(f"{config.out}: expected a place in a folder, found {blocking} to be a file")
    if config.out.is_file() and not paper_sheet.is_sheet(config.out):
        expected, found = "expected nothing or a sheet as it was written", "found a file of others, or a changed one"
        raise InputError(f"{config.out}: {expected}, {found}; choose another out")
    if config.part == "protocol":
        write_protocol(config)
    elif config.part == "target":
        draw_targets(config, config.rig.targets[config.body])
    else:
        draw_board(config, USUAL if config.board is None else design(config.board))


def write_protocol(config: Config) -> None:
    """Write the card of what to record; raises InputError with the paper that is large enough."""
    paper = PAPERS[config.paper] if isinstance(config.paper, str) else config.paper
    if paper[0] < PAPERS["a4"][0] or paper[1] < PAPERS["letter"][1]:
        expected = "210x279.4 mm or more, upright, for the protocol's page"
        raise InputError(f"paper: expected {expected}, found {paper[0]:g}x{paper[1]:g} mm; give paper=a4 or paper=letter")
    config.out.parent.mkdir(parents=True, exist_ok=True)
    with atomic.new_file(config.out) as path:
        protocol_card.write(path, paper, config.margin_mm)
    minutes = sum(step.minutes for step in protocol_card.STEPS)
    print(f"{config.part:11} {len(protocol_card.STEPS)} steps, {minutes} minutes")
    print(f"wrote       {config.out}")
    print(f"next        {protocol_card.AFTER}")


def draw_board(config: Config, board: Board) -> None:
    """Draw a calibration board."""
    check_discs(board)
    card, words = board_drawing.card_of(board), board_drawing.in_words(board)
    sheet = placed(config, card, shorter_board(config, board))
    scale = "Rulers not 100.0 mm long? Multiply the board's lengths by their mean / 100, wherever you give board={...}."
    write(config, [page(card, sheet, words, [scale, "Matt paper, glued flat onto glass or aluminium."])], words)
    field = f"board='{board_drawing.as_field(board)}'"
    report(config, card, sheet, f"sonotwin describe folder=poses {field} out=capture  # with the lengths as printed")


def draw_targets(config: Config, first: Target) -> None:
    """Draw a body's target, or a family of which it is the first."""
    targets = [first] if config.family is None else target_family.propose(first, config.family)
    scale = "Rulers not 100.0 mm long? Multiply c1_mm by the lower / 100 and c2_mm by the left / 100, or film it"
    care = "This side up: c0 is below at the left. Matt paper, glued flat onto a stiff board."
    pages = []
    for target in targets:
        card = target_drawing.card_of(target)
        notes = [f"{scale}: sonotwin calibrate-target.", care]
        pages.append(page(card, placed(config, card, ""), target_drawing.in_words(target), notes))
    title = target_drawing.in_words(first) if len(targets) == 1 else f"{len(targets)} targets"
    write(config, pages, title)
    own = "" if config.body == PROBE else f" body={config.body}"
    following = f"sonotwin calibrate-target capture=film{own} out=target  # of a film of it as it was printed"
    report(config, pages[0].card, pages[0].sheet, following)
    names = {_lengths(target): name for name, target in config.rig.bodies.items()}
    if len(targets) > 1:
        print(f"page 1      the {config.body}'s; in a rig's file, with names of your own for the others:")
        print("            bodies:")
    for number, target in enumerate(targets[1:], start=2):
        parted = min(parted_mm(target, other) for other in targets if other is not target)
        given = (*target.LENGTHS, "outer_diameter_mm", "inner_diameter_mm", "board_mm")
        described = target.model_dump(mode="json")
        fields = ", ".join(f"{name}: {described[name]}" for name in given)
        name = names.get(_lengths(target), f"body{number}")
        print(f"              {name}: {{{fields}}}  # page {number}, parted by {parted:.1f} mm from the others")


def _lengths(target: Target) -> tuple[float, ...]:
    """By which a target is told from others."""
    return tuple(getattr(target, name) for name in target.LENGTHS)


def near(name: str, rig: Rig) -> str:
    """The body that a name may mean."""
    return did_you_mean(name, list(rig.targets))


def check_discs(board: Board) -> None:
    """Refuse discs that touch each other."""
    if isinstance(board, Discs) and board.diameter_mm >= board.pitch_mm:
        expected = f"expected less than the {board.pitch_mm:.2f} mm between centres"
        raise InputError(f"board.diameter_mm: {expected}, found {board.diameter_mm:g}")


def placed(config: Config, card: Card, advice: str) -> Sheet:
    """The card's place on the paper; raises InputError with the paper that is large enough, and further advice."""
    paper: Size = PAPERS[config.paper] if isinstance(config.paper, str) else config.paper
    sheet = paper_sheet.lay_out(card.size, paper, config.margin_mm)
    if sheet is not None:
        return sheet
    width, height = paper_sheet.needed(card.size, config.margin_mm)
    large = paper_sheet.smallest_paper(card.size, config.margin_mm)
    ways = [f"give paper={large or f'[{width:.0f},{height:.0f}]'}", *([advice] if advice else [])]
    raise InputError(
        f"paper: expected {width:.0f}x{height:.0f} mm or more for a {config.part} of {card.size[0]:.0f}x{card.size[1]:.0f} mm "
        f"with its rulers, found {paper[0]:g}x{paper[1]:g} mm; {', or '.join(ways)}"
    )


def shorter_board(config: Config, board: Board) -> str:
    """The largest lengths with which a board of these numbers fits on the paper, as advice; empty if there are none."""
    paper: Size = PAPERS[config.paper] if isinstance(config.paper, str) else config.paper
    least, most = LEAST_SCALE, 1.0
    for _ in range(20):
        middle = (least + most) / 2
        small = board_drawing.scaled(board, middle)
        fits = paper_sheet.lay_out(board_drawing.card_of(small).size, paper, config.margin_mm) is not None
        least, most = (middle, most) if fits else (least, middle)
    if least == LEAST_SCALE:
        return ""
    return f"at most {board_drawing.lengths_in_words(board_drawing.scaled(board, least))}"


def page(card: Card, sheet: Sheet, words: str, notes: list[str]) -> Page:
    """A card on its sheet with the small print."""
    return Page(card, sheet, ["Print at 100 %, not fitted to the page, and measure both rulers.", f"sonotwin {words}.", *notes])


def write(config: Config, pages: list[Page], words: str) -> None:
    """Write the PDF."""
    config.out.parent.mkdir(parents=True, exist_ok=True)
    with atomic.new_file(config.out) as path:
        paper_sheet.write(path, pages, config.margin_mm, f"sonotwin {words}")


def report(config: Config, card: Card, sheet: Sheet, following: str) -> None:
    """Say what was drawn."""
    turned = "turned" if sheet.paper[0] > sheet.paper[1] else "upright"
    print(f"{config.part:11} {card.size[0]:g} x {card.size[1]:g} mm to cut out")
    print(f"paper       {sheet.paper[0]:g} x {sheet.paper[1]:g} mm, {turned}; print at 100 % and measure both rulers")
    print(f"wrote       {config.out}")
    print(f"next        {following}")
