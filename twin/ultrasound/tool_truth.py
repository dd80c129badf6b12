"""Ground truth of a tool in a B-scan: where its tip and its axis lie, and where the scanner shows them."""

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from scenes.handheld.shaft import Shaft
from twin.ultrasound.scan_lines import lines_of, on_lines, widening
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]


def placed(shaft: Shaft, transducer: Transducer, paths: Paths, world_from_image: Array) -> dict[str, Array]:
    """Truth of one B-scan, of a shaft in the world.

    Returns
    -------
    dict
        In mm in the image's frame, z across the plane: `tip_mm` (3,), and `axis_mm` (2, 3), its rear end first. As shown, with
        delays and refraction, px: `tip_px` (2,) of what lies in the image's plane below or above the tip; `axis_px` (2, 2), the
        ends of that part of the axis that lies over the image, and `axis_beside_mm` (2,) their distance from the plane; and
        `crossing_px` (2,), where the axis crosses the plane. NaN where there is none.
    """
    into = rigid.invert(world_from_image)
    tip, axis = rigid.apply(into, shaft.tip), rigid.apply(into, shaft.ends)
    over, crossing = _over_image(axis, transducer), np.full((1, 3), np.nan)
    if axis[0, 2] * axis[1, 2] < 0:
        crossing = (axis[:1] * axis[1, 2] - axis[1:] * axis[0, 2]) / (axis[1, 2] - axis[0, 2])
    shown = shown_px(np.concatenate([tip[None], over, crossing]), transducer, paths)
    return {
        "tip_mm": tip,
        "axis_mm": axis,
        "tip_px": shown[0],
        "axis_px": shown[1:3],
        "axis_beside_mm": over[:, 2],
        "crossing_px": shown[3],
    }


def _over_image(axis: Array, transducer: Transducer) -> Array:
    """Ends (2, 3) of the part of an axis whose x and y lie in the image; NaN if none does."""
    extent = np.array(transducer.scale_mm_per_px) * (np.array(transducer.image_size) - 1)
    step = axis[1] - axis[0]
    first, last = 0.0, 1.0
    for k in range(2):
        if step[k] == 0:
            last = last if 0 <= axis[0, k] <= extent[k] else -1.0
            continue
        ends = sorted((np.array([0.0, extent[k]]) - axis[0, k]) / step[k])
        first, last = max(first, ends[0]), min(last, ends[1])
    return axis[0] + np.outer([first, last], step) if first <= last else np.full((2, 3), np.nan)


def shown_px(points: Array, transducer: Transducer, paths: Paths) -> Array:
    """Pixels (n, 2) at which places (n, 3) mm in the image's frame are shown, as if they lay in its plane."""
    lines, corner = lines_of(transducer), np.array([0.0, 0.0] if transducer.face is None else transducer.face_mm)
    x, y = (points[:, :2] - corner).T
    along, depth = on_lines.py_func(x, y, lines.bend, lines.middle_mm)
    known = np.isfinite(along)
    line = np.clip(np.rint(np.where(known, along, 0) / lines.pitch_mm).astype(int), 0, len(paths.labels) - 1)
    levels = paths.step_mm * np.arange(paths.labels.shape[1])
    seen, aside = (
        np.array([np.interp(d, levels, table[k]) for k, d in zip(line, depth, strict=True)])
        for table in (paths.shown_mm, paths.shift_mm)
    )
    seen = np.where(depth < 0, depth, seen)
    along = along - aside / widening(depth, lines.bend)
    if lines.bend:
        angle, far = (along - lines.middle_mm) * lines.bend, 1 / lines.bend + seen
        x, y = far * np.sin(angle), far * np.cos(angle) - 1 / lines.bend
    else:
        x, y = along, seen
    return (np.column_stack([x, y]) + corner) / transducer.scale_mm_per_px
