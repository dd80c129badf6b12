"""A check that bodies made of parts share."""

import numpy as np

from scenes.handheld.mesh_parts import SLOTS


def check_closed(parts, sheet):
    """All parts have a known slot and finite vertices; all but the sheet are closed and face outwards."""
    for part in parts:
        assert part.slot in SLOTS and np.isfinite(part.mesh.vertices).all()
        if part.slot != sheet:
            assert part.mesh.is_watertight and part.mesh.is_winding_consistent, part.slot
            assert part.mesh.volume > 0, part.slot
