"""Make the README's pictures from what `make demo` left in outputs/demo: `.venv/bin/python docs/picture.py`.

`docs/picture.py FILM` makes the gallery's frames from a film, such as `sonotwin film path=pivot frames=200 out=FILM`.
"""

import sys
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LightSource

from sonotwin.rendered_session import BOTTOM, SCAN
from twin.evaluation import session_errors, surface_errors, sweep_errors
from twin.evaluation.sweep_errors import nearest_frame
from twin.reports import sweep_pictures, sweep_report

DEMO = Path("outputs/demo")
INCH_PX = 80
TABLE_MM = 697.0  # beyond which the table lies
SMOOTHED_PX = 2.0  # for the shading alone: bare noise of 0.02 mm would show


def outside() -> None:
    """Four panels: the scene, its fringes, the reconstructed surface, its errors."""
    images = [cv2.imread(str(DEMO / "capture/surface/cam1" / f"{k:04d}.png"), cv2.IMREAD_GRAYSCALE) for k in range(9)]
    points, sigma = surface_errors.read_points(DEMO / "result/surface/points.npz")
    error = surface_errors.compare(points, sigma, surface_errors.read_truth(DEMO / "truth")).error
    known = np.isfinite(points[..., 2])
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), SMOOTHED_PX)
    height = -cv2.GaussianBlur(np.where(known, points[..., 2], 0).astype(np.float32), (0, 0), SMOOTHED_PX) / np.maximum(
        weight, 1e-3
    )
    pixel_mm = np.nanmedian(np.diff(points[..., 0], axis=1))
    shaded = LightSource(azdeg=300, altdeg=40).hillshade(height, dx=pixel_mm, dy=pixel_mm)

    figure, axes = plt.subplots(1, 4, figsize=(16, 3.7), layout="constrained")
    axes[0].imshow(np.mean(images[1:], axis=0) ** 0.6, cmap="gray")
    axes[1].imshow(images[3], cmap="gray", vmax=200)
    axes[2].imshow(np.where(known, shaded, np.nan), cmap="gray", vmin=0, vmax=1)
    scale = axes[3].imshow(error, cmap="RdBu_r", vmin=-0.1, vmax=0.1, interpolation="nearest")
    figure.colorbar(scale, ax=axes[3], label="error, mm", shrink=0.85)
    for panel, title in zip(
        axes, ("as camera 1 sees it", "under fringes", "reconstructed surface", "error against the truth"), strict=True
    ):
        panel.set_title(title)
        panel.set_axis_off()
    figure.savefig("docs/images/demo.png", dpi=INCH_PX)


def inside() -> None:
    """The measured skin with the tumours found under it, and a B-scan through each beside what it should show."""
    truth = sweep_errors.read_truth(DEMO / "truth", SCAN)
    findings = session_errors.findings(DEMO / "result", truth, SCAN)
    story = sweep_report.read(DEMO / "result", SCAN, BOTTOM, findings, truth)
    figure = plt.figure(figsize=(16, 3.4), layout="constrained")
    axes = figure.add_subplot(1, 4, 1, projection="3d", computed_zorder=False)
    skin = surface_errors.read_points(DEMO / "result/surface/points.npz")[0][::8, ::8]
    breast = np.where((skin[..., 2] < TABLE_MM)[..., None], skin, np.nan)
    axes.plot_wireframe(*shown(breast), rcount=60, ccount=60, color="0.6", linewidth=0.3)
    for finding in findings:
        if finding.found is not None:
            corners = np.stack(shown(finding.found.vertices), axis=-1)
            axes.plot_trisurf(*corners.T, triangles=finding.found.faces, color=sweep_pictures.FOUND, linewidth=0)
    axes.set_box_aspect([np.ptp(axis[np.isfinite(axis)]) for axis in shown(breast)], zoom=1.5)
    axes.view_init(elev=18, azim=-60)
    axes.set_axis_off()
    axes.set_title("tumours found under the measured skin")
    for panel, finding in enumerate(findings, 2):
        number = nearest_frame(finding.true.center_mass, story.world_from_pixel, story.sweep.size)
        axes = figure.add_subplot(1, 4, panel)
        if number is not None:
            image = story.sweep.image(number)
            axes.imshow(sweep_pictures.beside_truth(image, number, story.world_from_pixel[number], findings, truth))
        axes.set_title("a B-scan and what it should show")
        axes.set_axis_off()
    figure.savefig("docs/images/inside.png", dpi=INCH_PX)


def shown(points: np.ndarray) -> list[np.ndarray]:
    """Coordinates x, y, z of points : (..., 3) with the camera's view from above: z up."""
    return [points[..., 0], -points[..., 1], -points[..., 2]]


def frames(film: Path) -> None:
    """Three frames of camera 1, brightened as one would on a screen, and one as it is."""
    paths = sorted((film / "capture/sweep/cam1").glob("*.png"))
    images = [cv2.imread(str(paths[k * (len(paths) - 1) // 3]), cv2.IMREAD_GRAYSCALE) for k in range(4)]
    shown = [images[0], *(np.uint8(np.rint(255 * (image / 255) ** 0.5)) for image in images[1:])]
    small = [cv2.resize(image, (480, 384), interpolation=cv2.INTER_AREA) for image in shown]
    packing = [cv2.IMWRITE_JPEG_QUALITY, 85]
    cv2.imwrite("docs/images/frames.jpg", np.vstack([np.hstack(small[:2]), np.hstack(small[2:])]), packing)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        frames(Path(sys.argv[1]))
    else:
        outside()
        inside()
