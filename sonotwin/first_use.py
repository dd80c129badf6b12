"""Announces on the console what is compiled on first use: a line for each part of the software, not for each function."""

import logging
import sys

PARTS = {  # the modules' beginnings, what the console calls them, and the seconds that a core takes for all of their functions
    "recon.structured_light": ("decoder and mesh", 20),
    "recon.tracking": ("fit of the target's rims", 20),
    "recon.optical_calibration": ("images of the board in the projector", 15),
    "recon.board_detection": ("edges of the board's circles", 5),
    "recon.clips": ("lossless JPEG", 5),
    "recon.freehand": ("volume from B-scans", 5),
    "recon.segmentation": ("search for masses", 5),
    "recon.geometry": ("cameras", 5),
    "recon.devices": ("checksums of messages", 1),
    "recon.skin_projection": ("lines onto the skin", 5),
    "twin.ultrasound": ("the rendered scanner", 45),
    "twin.optics": ("light transport", 5),
    "twin": ("the rendered sensor", 3),
}


class Announcer(logging.Handler):
    """Prints a line on stderr for the first function of each part that is compiled, or that another process compiles."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._announced: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Announce the part of the function that the record names, unless it has been announced alike."""
        module = str(record.args[0]) if isinstance(record.args, tuple) and record.args else ""
        part = next((part for part in PARTS if f"{module}.".startswith(f"{part}.")), None)
        if part is None:
            return
        name, seconds = PARTS[part]
        if str(record.msg).startswith("waiting"):
            line = f"wait        for another process that compiles the {name.removeprefix('the ')}"
        else:
            line = f"compile     {name}, once on this machine (up to {seconds} s)"
        if line not in self._announced:
            self._announced.add(line)
            print(line, file=sys.stderr, flush=True)


def announce() -> None:
    """Announce what is compiled from now on, unless the logger was given a level of its own."""
    log = logging.getLogger("recon.compiled")
    if log.level == logging.NOTSET:
        log.setLevel(logging.INFO)
        log.addHandler(Announcer())
