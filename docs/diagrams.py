"""Draw the documentation's diagrams, docs/images/*.svg: `.venv/bin/python docs/diagrams.py`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH, HEIGHT = 150, 46  # px, of a box
STEP = (186, 78)  # from one box to the next: to the right, down
Place = tuple[float, float]  # column, row

DIAGRAMS: dict[str, tuple[dict[str, Place], list[tuple[str, str]]]] = {
    "packages": (
        {
            "sonotwin|command, interface": (1, 0),
            "twin|simulated instruments": (0.4, 1),
            "trainers|network training": (1.6, 1),
            "scenes|things": (0.4, 2),
            "recon|the rig's software": (1, 3),
        },
        [("sonotwin", "twin"), ("sonotwin", "trainers"), ("twin", "scenes"), ("scenes", "recon"), ("trainers", "recon")],
    ),
    "surface": (
        {
            "capture|images, patterns": (0, 0),
            "phase|sigma, modulation": (1, 0),
            "fringe order|Gray, line, pitches": (2, 0),
            "projector map|columns, rows": (3, 0),
            "calibration|camera, projector": (2, 1),
            "points|and their sigma": (3, 1),
            "mesh|PLY, GLB": (4, 1),
        },
        [
            ("capture", "phase"),
            ("phase", "fringe order"),
            ("fringe order", "projector map"),
            ("projector map", "points"),
            ("calibration", "points"),
            ("points", "mesh"),
        ],
    ),
    "twin": (
        {
            "scene|meshes, materials": (0, 0),
            "rig|cameras, projector": (0, 1),
            "light transport|all patterns at once": (1, 0.5),
            "sensor|EMVA 1288": (2, 0),
            "capture|as devices write it": (3, 0),
            "truth|points, poses, masks": (2, 1),
            "pipeline|recon": (4, 0),
            "evaluation|errors, reports": (4, 1),
        },
        [
            ("scene", "light transport"),
            ("rig", "light transport"),
            ("light transport", "sensor"),
            ("light transport", "truth"),
            ("sensor", "capture"),
            ("capture", "pipeline"),
            ("pipeline", "evaluation"),
            ("truth", "evaluation"),
        ],
    ),
    "calibration": (
        {
            "lit images|every camera": (0, 0),
            "fringes|camera 1": (0, 1),
            "points|centres, corners": (1, 0),
            "projector points|by the fringes": (1, 1),
            "observations|all poses": (2, 0.5),
            "first estimate|each device alone": (3, 0),
            "adjustment|all devices at once": (3, 1),
            "optics.yaml|with covariance": (4, 0.5),
            "page|figures, warnings": (4, 1.5),
        },
        [
            ("lit images", "points"),
            ("fringes", "projector points"),
            ("points", "projector points"),
            ("points", "observations"),
            ("projector points", "observations"),
            ("observations", "first estimate"),
            ("first estimate", "adjustment"),
            ("observations", "adjustment"),
            ("adjustment", "optics.yaml"),
            ("adjustment", "page"),
        ],
    ),
    "tracking": (
        {
            "pair of frames|camera 1 and 2": (0, 0.5),
            "predicted|by the last poses": (1, 0),
            "segmented|patches": (1, 1),
            "detected|whole frames": (1, 2),
            "rims|three circles a view": (2, 0.5),
            "pose|both views": (3, 0),
            "reason|no pose": (3, 1),
        },
        [
            ("pair of frames", "predicted"),
            ("predicted", "segmented"),
            ("segmented", "detected"),
            ("predicted", "rims"),
            ("segmented", "rims"),
            ("detected", "rims"),
            ("rims", "pose"),
            ("rims", "reason"),
        ],
    ),
    "ultrasound": (
        {
            "frames|camera 1 and 2": (0, 0),
            "track|world_from_target": (1, 0),
            "poses|at the scans' times": (2, 0),
            "B-scans|the scanner's clock": (0, 1),
            "lag|between the clocks": (1, 1),
            "probe|target_from_image": (1, 2),
            "placed pixels|world_from_pixel": (2, 1),
            "volume|NRRD, PLUS": (3, 0.5),
            "masses, tubes|closed surfaces": (3, 1.5),
        },
        [
            ("frames", "track"),
            ("track", "poses"),
            ("B-scans", "lag"),
            ("lag", "poses"),
            ("poses", "placed pixels"),
            ("probe", "placed pixels"),
            ("placed pixels", "volume"),
            ("placed pixels", "masses, tubes"),
        ],
    ),
}


def svg(boxes: Mapping[str, Place], arrows: Sequence[tuple[str, str]]) -> str:
    """One diagram: boxes by `title|subtitle` with their places, arrows by titles."""
    middles = {
        name.partition("|")[0]: (column * STEP[0] + WIDTH / 2 + 8, row * STEP[1] + HEIGHT / 2 + 8)
        for name, (column, row) in boxes.items()
    }
    width, height = (round(max(middle[k] for middle in middles.values()) + (WIDTH, HEIGHT)[k] / 2 + 8) for k in (0, 1))
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" text-anchor="middle">',
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#556"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for start, end in arrows:
        (x0, y0), (x1, y1) = _ends(middles[start], middles[end])
        lines.append(f'<path d="M{x0:g} {y0:g} {x1:g} {y1:g}" stroke="#556" stroke-width="1.5" marker-end="url(#head)"/>')
    for name in boxes:
        title, _, subtitle = name.partition("|")
        x, y = middles[title]
        lines.append(
            f'<rect x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="#eef3f8" '
            'stroke="#456"/>'
        )
        lines.append(f'<text x="{x:g}" y="{y - 3:g}" font-size="14" font-weight="bold" fill="#123">{title}</text>')
        lines.append(f'<text x="{x:g}" y="{y + 14:g}" font-size="12" fill="#345">{subtitle}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _ends(start: Place, end: Place) -> tuple[Place, Place]:
    """Ends of an arrow between two boxes' middles, on the borders of the boxes."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    share = min(WIDTH / 2 / abs(dx) if dx else 1e9, HEIGHT / 2 / abs(dy) if dy else 1e9)
    return (
        (round(start[0] + share * dx, 1), round(start[1] + share * dy, 1)),
        (round(end[0] - share * dx, 1), round(end[1] - share * dy, 1)),
    )


if __name__ == "__main__":
    for file, (boxes, arrows) in DIAGRAMS.items():
        (IMAGES / f"{file}.svg").write_text(svg(boxes, arrows), encoding="utf-8")
