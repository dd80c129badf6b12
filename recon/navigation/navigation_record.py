"""A table of a navigation that is written as it goes: of each moment a row for each body.

Each moment's rows are handed to the system at once, so that a run that is killed leaves a table that can be read.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic_ns, time_ns

import numpy as np
from numpy.typing import NDArray

from recon.capture.sweep_tables import POSE
from recon.errors import InputError
from recon.model.rig import PATIENT, PROBE
from recon.navigation.publishing import BodyAt, Moment
from recon.navigation.tool_distances import TipFigures

Array = NDArray[np.float64]

MOMENT = ("moment", "time_ns", "frame_ns", "body", "found", "state")
TIP = ("tip_x_mm", "tip_y_mm", "tip_z_mm", "tip_sigma_mm")
PATH = ("path_mm", "path_sigma_mm", "path_deg", "aim_mm")
PLANE = ("image_mm", "image_sigma_mm", "crossing_u_px", "crossing_v_px", "crossing_mm", "crossing_in_image")


class RecordTable:
    """A publisher that writes each moment into a table.

    `time_ns` is since 1970, of camera 1's exposure. `frame_ns` is by that camera's own clock; of a capture it is the time in its
    tables, which goes on in later rounds.
    The patient's pose is as the cameras see it; all others are in the world in which skin and masses were measured.
    """

    name = "record"

    def __init__(self, path: Path, bodies: Sequence[str], masses: Sequence[str]) -> None:
        """Begin a table, a new file, of bodies besides the probe.

        Raises
        ------
        InputError
            If a file is there already, or none can be written there.
        """
        self._path, self._bodies, self._masses = path, (PROBE, *bodies), tuple(masses)
        self._since_1970 = time_ns() - monotonic_ns()
        try:
            self._stream = path.open("x", encoding="utf-8", newline="")
        except FileExistsError:
            raise InputError(f"record: expected a new file, found {path} there already; give another name") from None
        except OSError as error:
            raise InputError(f"record: expected a place to write to, found {path} refused: {error.strerror}") from None
        distances = [f"{name}_{figure}" for name in self._masses for figure in ("mm", "sigma_mm")]
        self._write([(*MOMENT, *POSE, *TIP, *distances, *PATH, *PLANE)])

    def publish(self, moment: Moment) -> None:
        """Write a moment; see `Publisher`. InputError if the disk refuses it."""
        self._write(self._rows(moment))

    def close(self) -> None:
        """End."""
        self._stream.close()

    def _write(self, rows: Sequence[Sequence[object]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        try:
            self._stream.write(text.getvalue())
            self._stream.flush()
        except OSError as error:
            raise InputError(f"record: expected {self._path} to take more, found it refused: {error.strerror}") from None

    def _rows(self, moment: Moment) -> list[list[object]]:
        at = {body.name: body for body in moment.bodies}
        at[PROBE] = BodyAt(PROBE, moment.state, moment.world_from_target)
        since_1970 = moment.exposed_ns + self._since_1970
        frame = "" if moment.frame_ns is None else moment.frame_ns
        rows = []
        for name in self._bodies:
            body = at.get(name, BodyAt(name, moment.state))
            pose = body.camera_from_body if name == PATIENT else body.world_from_body
            start = [moment.number, since_1970, frame, name, int(pose is not None), body.state]
            rows.append([*start, *_pose(pose), *self._figures(body.figures)])
        return rows

    def _figures(self, found: TipFigures | None) -> Iterator[object]:
        """Numbers of a tip, empty where there is none."""
        if found is None:
            yield from [""] * (len(TIP) + 2 * len(self._masses) + len(PATH) + len(PLANE))
            return
        yield from (*found.tip.tolist(), found.sigma_mm)
        for name in self._masses:
            yield from found.masses[name]
        path, plane = found.path, found.plane
        yield from [""] * len(PATH) if path is None else _told(path.off_mm, path.off_sigma_mm, path.angle_deg, path.left_mm)
        crossing = None if plane is None else plane.crossing
        yield from ["", ""] if plane is None else [plane.off_mm, plane.sigma_mm]
        yield from [""] * 4 if crossing is None else [*crossing.pixel.tolist(), crossing.ahead_mm, int(crossing.in_image)]


def _pose(pose: Array | None) -> list[object]:
    return [""] * len(POSE) if pose is None else list(pose[:3].ravel().tolist())


def _told(*values: float | None) -> list[object]:
    return ["" if value is None else value for value in values]
