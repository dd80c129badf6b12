"""`certificate.pdf`: the same certificate on paper, with lines to sign."""

from collections.abc import Sequence
from pathlib import Path

from reportlab.lib.colors import HexColor
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import Flowable, KeepTogether, Paragraph, SimpleDocTemplate, Spacer, Table

from recon.acceptance import certificate_page
from recon.acceptance.certificate_page import ARTEFACT_HEAD, BUDGET_HEAD, COLOURS, DEMAND_HEAD, READING, UNSIGNED, Subject
from recon.acceptance.optical_acceptance import CHARACTERISTICS, Acceptance, Judged
from recon.artwork import paper_sheet
from recon.artwork.paper_sheet import BOLD, FONT

SIDE = 48.0  # points, margin
INK, GREY, RULE = HexColor("#1d2733"), HexColor("#5f6b78"), HexColor("#c9d0d7")
TEXT = ParagraphStyle("text", fontName=FONT, fontSize=8.5, leading=11, textColor=INK)
SMALL = ParagraphStyle("small", TEXT, fontSize=7.5, leading=9.5, textColor=GREY)
CELL, HEAD = ParagraphStyle("cell", TEXT, fontSize=7.8, leading=9.6), ParagraphStyle("head", SMALL, fontName=BOLD)
TITLE = ParagraphStyle("title", TEXT, fontName=BOLD, fontSize=17, leading=21)
RESULT = ParagraphStyle("result", TEXT, fontName=BOLD, fontSize=10.5, leading=14)
SECTION = ParagraphStyle("section", TEXT, fontName=BOLD, fontSize=11, leading=14, spaceBefore=9, spaceAfter=3)


class _Against(Flowable):
    """A quantity in all places against its limit: marks with bars of uncertainty between minus and plus the limit."""

    WIDTH, HEIGHT = 118.0, 15.0
    REACH = 1.5  # limits, to both sides

    def __init__(self, values: Sequence[Judged]) -> None:
        super().__init__()
        self.values = values

    def wrap(self, aW: float, aH: float) -> tuple[float, float]:
        """Width and height, whatever room there is."""
        return self.WIDTH, self.HEIGHT

    def draw(self) -> None:
        """Draw from the left, minus the reach, to the right."""
        canvas: Canvas = self.canv
        canvas.setStrokeColor(GREY)
        canvas.setLineWidth(0.5)
        canvas.line(self._x(-self.REACH), self.HEIGHT / 2, self._x(self.REACH), self.HEIGHT / 2)
        canvas.line(self._x(0), self.HEIGHT / 2 - 2, self._x(0), self.HEIGHT / 2 + 2)
        canvas.setLineWidth(1.1)
        for limit in (-1.0, 1.0):
            canvas.line(self._x(limit), 0, self._x(limit), self.HEIGHT)
        for number, one in enumerate(self.values):
            if one.limit_mm is None:
                continue
            y = self.HEIGHT * (number + 0.5) / len(self.values)
            colour = HexColor(COLOURS[one.decision])
            canvas.setStrokeColor(colour)
            canvas.setFillColor(colour)
            canvas.setLineWidth(0.8)
            value, expanded = one.budget.value_mm / one.limit_mm, one.budget.expanded_mm / one.limit_mm
            canvas.line(self._x(value - expanded), y, self._x(value + expanded), y)
            canvas.circle(self._x(value), y, 1.0, stroke=0, fill=1)

    def _x(self, of_limit: float) -> float:
        reach = self.REACH
        return self.WIDTH * (min(max(of_limit, -reach), reach) + reach) / (2 * reach)


def write(path: Path, found: Acceptance, subject: Subject) -> int:
    """Write the PDF; returns the number of its pages. The same input gives the same bytes."""
    document = SimpleDocTemplate(
        str(path),
        pagesize=A4,
        leftMargin=SIDE,
        rightMargin=SIDE,
        topMargin=SIDE,
        bottomMargin=SIDE,
        title=f"sonotwin certificate of acceptance: {subject.instrument}",
        creator="sonotwin",
        invariant=1,
    )
    document.build(_content(found, subject), onFirstPage=_foot, onLaterPages=_foot)
    paper_sheet.mark(path)
    return document.page


def _content(found: Acceptance, subject: Subject) -> list[Flowable]:
    width = A4[0] - 2 * SIDE - 12
    rows = [
        [_p(f"<b>{symbol}</b>"), _p(CHARACTERISTICS[symbol].title), _p(CHARACTERISTICS[symbol].iso or ""),
         _p(certificate_page.in_words(one.budget)), _p("none" if one.limit_mm is None else f"{one.limit_mm:g} mm"),
         _p(found.decision_of(symbol) or "reported"), _Against([value for value in found.values if value.symbol == symbol])]
        for symbol, one in found.worst_values.items()
    ]  # fmt: skip
    head = ("", "quantity", "ISO 10360-13", "worst ± U (95 %)", "limit", "decision", "all places, − limit to + limit")
    tables = list[Flowable]()
    for symbol, one in found.worst_values.items():
        lines = [[_p(cell) for cell in row] for row in certificate_page.budget_rows(one.budget)]
        table = _table(BUDGET_HEAD, lines, (128, 74, 68, 68, 52, 58, 52))
        title = Paragraph(f"{symbol} at {one.place}", ParagraphStyle("of", CELL, fontName=BOLD, spaceBefore=6, spaceAfter=2))
        above = [] if tables else [Paragraph("Uncertainty budgets, of the places that decide", SECTION)]
        tables += [KeepTogether([*above, title, table, Paragraph(certificate_page.budget_summary(one).replace("−", "-"), SMALL)])]
    demands = [[_p(cell) for cell in row] for row in certificate_page.demand_rows(found)]
    artefacts = [[_p(cell) for cell in row] for row in certificate_page.artefact_rows(subject.artefacts)]
    signed = [[_p(name), _p("" if value == UNSIGNED else value)] for name, value in certificate_page.signature_rows(subject)]
    return [
        Paragraph("Certificate of acceptance", ParagraphStyle("kind", SMALL, fontSize=9)),
        Paragraph(_safe(subject.instrument), TITLE),
        Spacer(0, 4),
        Paragraph(_safe(certificate_page.verdict(found)), RESULT),
        Paragraph("Test values", SECTION),
        _table(head, rows, (28, 104, 72, 82, 38, 43, _Against.WIDTH)),
        KeepTogether([Paragraph("Signed", SECTION), _table(("", ""), signed, (90, width - 90), high=19)]),
        KeepTogether([Paragraph("Artefacts", SECTION), _table(ARTEFACT_HEAD, artefacts, (160, 120, 120)),
                      Paragraph(certificate_page.room(subject.artefacts), SMALL)]),
        *([KeepTogether([Paragraph("Arrangement", SECTION), _table(DEMAND_HEAD, demands, (220, 160, 60))])] if demands else []),
        *tables,
        KeepTogether([Paragraph("How to read this", SECTION), *[Paragraph(_safe(text), SMALL) for text in READING]]),
    ]  # fmt: skip


def _table(head: Sequence[str], rows: Sequence[Sequence[Flowable]], widths: Sequence[float], high: float | None = None) -> Table:
    top = [] if not any(head) else [[Paragraph(_safe(cell), HEAD) for cell in head]]
    table = Table([*top, *map(list, rows)], colWidths=widths, rowHeights=high, hAlign="LEFT", repeatRows=len(top))
    table.setStyle([
        ("VALIGN", (0, 0), (-1, -1), "MIDDLE"),
        ("LEFTPADDING", (0, 0), (-1, -1), 2),
        ("RIGHTPADDING", (0, 0), (-1, -1), 2),
        ("TOPPADDING", (0, 0), (-1, -1), 1.5),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
        ("LINEBELOW", (0, 0), (-1, -1), 0.4, RULE),
    ])  # fmt: skip
    return table


def _p(text: str) -> Paragraph:
    return Paragraph(text if text.startswith("<b>") else _safe(text), CELL)


def _safe(text: str) -> str:
    """Text for a paragraph, in the letters that the font has."""
    plain = text.replace("−", "-").replace("\u202f", " ").replace("’", "'")
    return plain.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _foot(canvas: Canvas, document: SimpleDocTemplate) -> None:
    canvas.setFont(FONT, 7)
    canvas.setFillColor(GREY)
    canvas.drawString(SIDE, 0.55 * SIDE, certificate_page.FOOTER.split(". This")[0] + ".")
    canvas.drawRightString(A4[0] - SIDE, 0.55 * SIDE, f"page {document.page}")
