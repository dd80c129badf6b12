"""The scanner's latency as the fields of verbs."""

from pathlib import Path
from typing import NamedTuple

from recon.capture import lag_files


class Latency(NamedTuple):
    """The lag of the scanner's images, s, and its standard deviation."""

    lag_s: float
    sigma_s: float
    assumed: bool = False  # for want of a measured or a given one

    @property
    def field(self) -> str:
        """The lag as a field of a verb."""
        return f"lag_s={self.lag_s:.15g}"

    @property
    def fields(self) -> list[str]:
        """Both as fields of a verb; none of a lag that is assumed, as the verb assumes it too, with its uncertainty."""
        return [] if self.assumed else [self.field, f"lag_sigma_s={self.sigma_s:.15g}"]


def measured(folder: Path) -> Latency:
    """The latency that `sonotwin measure-lag` wrote into a folder; InputError as of `recon.capture.lag_files.read`."""
    found = lag_files.read(folder / lag_files.FILE)
    return Latency(found.lag_s, found.sigma_s)
