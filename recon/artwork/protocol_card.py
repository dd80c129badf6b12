"""The protocol card: one page for whoever records a rig, with all that `sonotwin identify` needs, step by step.

The table of docs/identify.md is made of the same steps.
"""

from pathlib import Path
from typing import NamedTuple

from reportlab.lib.colors import HexColor
from reportlab.lib.styles import ParagraphStyle
from reportlab.platypus import Flowable, Paragraph, SimpleDocTemplate, Spacer, Table

from recon.artwork import paper_sheet
from recon.artwork.paper_sheet import BOLD, FONT, Size

TITLE = "Record your rig in 20 minutes"
POINT_MM, MINUTES_WIDTH = 25.4 / 72, 42.0  # the column of minutes in points
INK, GREY, ACCENT = HexColor("#1d2733"), HexColor("#5f6b78"), HexColor("#2f6f9f")


class Step(NamedTuple):
    """What is recorded, and the marks of a good recording."""

    minutes: int
    name: str
    record: str
    shows: str
    hints: str  # to whoever records it
    right: tuple[str, ...]  # what is to be seen then, each to be ticked
    place: str  # command that records it, or folder of its images
    command: bool


STEPS = (
    Step(
        10,
        "Board",
        "the board of discs in 10 to 30 poses, near and far, under patterns of both axes",
        "optics and places; blur, f-number, focus; vignetting of cameras and projector",
        "Go where the outline on the screen is: near, far, to the corners, tilted to all sides. Hold still until it says kept.",
        ("12 poses or more are kept", "rims are sharp, and no white is saturated"),
        "sonotwin record part=board patterns=gray_alone devices=ours.yaml rig=our_rig.yaml out=session",
        True,
    ),
    Step(
        2,
        "Surface",
        "a matt, light surface as deep as the working range, under 8 steps or more and Gray code",
        "gamma, blur and focus of the projector; flicker, stray light, errors of the shifts",
        "Plaster, or a ball of 10 cm. The program sets the exposure, that of steps 3 and 4, too.",
        ("it says kept", "fringes of 50 DN or more, hardly any saturated"),
        "sonotwin record part=surface patterns=gray_surface devices=ours.yaml rig=our_rig.yaml out=session",
        True,
    ),
    Step(
        1,
        "Room",
        "the same with the projector covered, 2 images or more of each camera",
        "contrast: the projector's black apart from the room's light",
        "Hold black card before the projector's lens. Move nothing else.",
        ("it says kept", "the surface is dark, but not blacker than in step 4"),
        "sonotwin record part=room devices=ours.yaml rig=our_rig.yaml out=session",
        True,
    ),
    Step(
        1,
        "Dark",
        "16 images with the lens caps on, at the exposure of the fringes",
        "black level, dark noise, DSNU",
        "Best with a black cloth over the caps.",
        ("it says kept", "all is black, without a brighter edge"),
        "sonotwin record part=dark devices=ours.yaml rig=our_rig.yaml out=session",
        True,
    ),
    Step(
        2,
        "Flat",
        "16 images of white paper out of focus at half the brightness, 16 at full, projector on",
        "electrons a digital number, PRNU",
        "Matt, a hand's breadth before each lens, square to it. The program sets the exposures.",
        ("it says kept", "corners have half of the middle's light or more"),
        "sonotwin record part=flat devices=ours.yaml rig=our_rig.yaml out=session",
        True,
    ),
    Step(
        4,
        "Ultrasound",
        "B-scans of a tissue phantom, each elsewhere; the probe in air; the probe on a slide, 0.2 mm from one to the next",
        "[the scanner](#the-scanner)",
        "Depth, gain and focus as in use; gel on a phantom without cysts; a micrometer moves the probe.",
        ("20 B-scans or more of speckle alone", "nothing is white all over"),
        "session/us/tissue, session/us/air and session/us/steps, as images",
        False,
    ),
)
BEFORE = (
    "ours.yaml names your devices: serial numbers, the projector's display. How to write it: docs/live.md, A first session.",
    "our_rig.yaml describes them: sizes, pixels, lenses, rough places. How to write it: docs/identify.md, A file to begin with.",
    "All devices have been on for 15 minutes.",
    "Room lights are as in use; no daylight.",
    "Focus, aperture and gain are as in use, their rings locked.",
    "Automatic exposure, gain and gamma are off.",
)
AFTER = (
    "sonotwin identify capture=session rig=our_rig.yaml tissue=session/us/tissue air=session/us/air steps=session/us/steps "
    "step_mm=0.2 clip=[U,V,W,H] mm_per_px=[X,Z] frequency_mhz=F out=identified"
)


class _Box(Flowable):
    """A box to be ticked."""

    SIDE = 7.5

    def wrap(self, aW: float, aH: float) -> tuple[float, float]:
        """Width and height, whatever room there is."""
        return self.SIDE, self.SIDE

    def draw(self) -> None:
        """Draw its outline."""
        self.canv.setStrokeColor(INK)
        self.canv.setLineWidth(0.7)
        self.canv.rect(0, 0, self.SIDE, self.SIDE)


def write(path: Path, paper: Size, margin_mm: float) -> int:
    """Write the card as PDF; returns the number of its pages, which is one if the paper is large enough.

    The same input gives the same bytes.
    """
    side = max(margin_mm, 14.0) / POINT_MM
    width = paper[0] / POINT_MM - 2 * side
    document = SimpleDocTemplate(
        str(path),
        pagesize=(paper[0] / POINT_MM, paper[1] / POINT_MM),
        leftMargin=side,
        rightMargin=side,
        topMargin=side,
        bottomMargin=side,
        title=f"sonotwin {TITLE}",
        creator="sonotwin",
        invariant=1,
    )
    document.build(_content(width - 12))  # a frame's own padding
    paper_sheet.mark(path)
    return document.page


def _content(width: float) -> list[Flowable]:
    """The card from its top, of a width in points."""
    plain = ParagraphStyle("plain", fontName=FONT, fontSize=9.5, leading=12, textColor=INK)
    small = ParagraphStyle("small", plain, fontSize=8.5, leading=11, textColor=GREY)
    code = ParagraphStyle("code", plain, fontName="Courier-Bold", fontSize=7.8, leading=12, textColor=ACCENT)
    title = ParagraphStyle("title", plain, fontName=BOLD, fontSize=20, leading=25)
    head = ParagraphStyle("head", plain, fontName=BOLD, fontSize=12, leading=15)
    number = ParagraphStyle("number", head, fontSize=22, leading=24, textColor=ACCENT)
    beside, gap = 0.3 * width, 14.0
    middle = width - MINUTES_WIDTH - beside
    tight = [("VALIGN", (0, 0), (-1, -1), "TOP"), ("TOPPADDING", (0, 0), (-1, -1), 0), ("BOTTOMPADDING", (0, 0), (-1, -1), 1)]
    tight += [("LEFTPADDING", (0, 0), (-1, -1), 0), ("RIGHTPADDING", (0, 0), (-1, -1), 0)]

    def ticks(lines: tuple[str, ...], across: float) -> Table:
        return Table([[_Box(), Paragraph(one, plain)] for one in lines], [14, across - 14], style=tight)

    rows: list[list[object]] = []
    for k, step in enumerate(STEPS, start=1):
        text = Paragraph(f"{step.record[0].upper()}{step.record[1:]}. {step.hints}", plain)
        first = [Paragraph(str(k), number), Paragraph(f"{step.minutes} min", small)]
        rows.append([first, [Paragraph(step.name, head), text], ticks(step.right, beside)])
        rows.append(["", Paragraph(f"{'' if step.command else 'into '}{step.place}", code), ""])
    commands = range(1, len(rows), 2)
    grid = [("LINEABOVE", (0, k - 1), (-1, k - 1), 0.5, GREY) for k in commands]
    grid += [("LINEBELOW", (0, -1), (-1, -1), 0.5, GREY)]
    spaced = [*tight, ("RIGHTPADDING", (1, 0), (1, -1), gap)]
    for k in commands:
        spaced += [("SPAN", (0, k - 1), (0, k)), ("SPAN", (1, k), (-1, k)), ("RIGHTPADDING", (1, k), (-1, k), 0)]
        spaced += [("TOPPADDING", (0, k - 1), (-1, k - 1), 5), ("BOTTOMPADDING", (0, k), (-1, k), 5)]
    written = [[Paragraph(one, small) for one in ("Rig", "Date, name", "Exposure of camera 1 and 2", "Gain")]]
    return [
        Paragraph(TITLE, title),
        Paragraph("One folder, six recordings. Tick what you see; what isn't so is mended, and recorded again at once.", small),
        Spacer(1, 8),
        Paragraph("Before you begin", head),
        Spacer(1, 3),
        ticks(BEFORE, width),
        Spacer(1, 8),
        Table(rows, [MINUTES_WIDTH, middle, beside], style=[*spaced, *grid]),
        Spacer(1, 8),
        Paragraph("Then", head),
        Paragraph(AFTER, code),
        Paragraph(
            "Letters stand for your numbers: the B-scan's left, top, width and height in an image, px; mm of a pixel along the "
            "array and in depth; MHz on the probe. It uses steps 1 to 5 as they lie in the folder, and says how well each number "
            "is known, or why it isn't. Without step 6, leave all from tissue to frequency_mhz out.",
            plain,
        ),
        Spacer(1, 8),
        Table(
            written,
            [0.2 * width, 0.3 * width, 0.33 * width, 0.17 * width],
            [32],
            style=[
                *tight,
                ("GRID", (0, 0), (-1, -1), 0.5, GREY),
                ("LEFTPADDING", (0, 0), (-1, -1), 4),
                ("TOPPADDING", (0, 0), (-1, -1), 2),
            ],
        ),
    ]
