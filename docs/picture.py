"""Make the README's picture from what `make demo` left in outputs/demo: `.venv/bin/python docs/picture.py`."""

from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LightSource

from twin import evaluate

DEMO = Path("outputs/demo")
SMOOTHED_PX = 2.0  # for the shading alone: bare noise of 0.02 mm would show


def main() -> None:
    """Four panels: the scene, its fringes, the reconstructed surface, its errors."""
    images = [cv2.imread(str(DEMO / "capture/surface/cam1" / f"{k:04d}.png"), cv2.IMREAD_GRAYSCALE) for k in range(9)]
    points, sigma = evaluate.read_points(DEMO / "surface/points.npz")
    error = evaluate.compare(points, sigma, evaluate.read_truth(DEMO / "truth")).error
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
    figure.savefig("docs/images/demo.png", dpi=80)


if __name__ == "__main__":
    main()
