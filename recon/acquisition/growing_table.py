"""A sweep's table of time stamps while it grows: rows are added whole, and what is torn at its end is mended."""

import errno
import os
from pathlib import Path

from recon.capture.sweep_tables import STAMPS


class GrowingTable:
    """`timestamps.csv` of one device, as `recon.capture.sweep_tables.read_stamps` reads it, a row at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
        self._head = ",".join(STAMPS) + "\n"

    def append(self, frame: int, time_ns: int) -> None:
        """Add a row, in one call of the system; OSError if it doesn't fit on the disk, and the table stays as it was."""
        row = f"{self._head}{frame},{time_ns}\n".encode("ascii")
        before = os.fstat(self._file).st_size
        try:
            if os.write(self._file, row) < len(row):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
        except OSError as error:
            os.ftruncate(self._file, before)
            error.filename = str(self._path)
            raise
        self._head = ""

    def close(self) -> None:
        """Close the file; may be called again."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1


def mend(path: Path) -> int:
    """Cut a table after its last whole row; returns the number of bytes that went."""
    with path.open("r+b") as stream:
        content = stream.read()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            stream.truncate(whole)
    return len(content) - whole
