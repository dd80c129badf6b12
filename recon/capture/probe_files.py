"""Files of the probe's calibration, each dialect a module of `probe_dialects`: sonotwin's own `probe.yaml`, the rig authors'
`US_params.npz`, plain matrices.

Own files and the authors' may state the unit of their lengths by a number `mm_per_unit`; without it lengths that no bracket has
are refused.
"""

from pathlib import Path

from recon import registry
from recon.capture.probe_dialects import own_probe
from recon.capture.probe_dialects.authors_probe import write as write_authors
from recon.capture.probe_dialects.own_probe import PARAMETERS, write
from recon.capture.probe_values import AUTHORS
from recon.errors import InputError
from recon.model.probe import ProbeCalibration

__all__ = ["AUTHORS", "PARAMETERS", "read", "write", "write_authors"]

DIALECTS = "recon.capture.probe_dialects"  # a module each


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read a probe's calibration of any of the dialects, recognised by its content.

    speed_m_s : of the sound for which sy holds, m/s, in a file that names none

    Raises
    ------
    InputError
        If the file is missing, damaged, of no known dialect, or a value is missing, not finite, no rotation, scale or speed.
    """
    path = Path(path)
    known = {name: dialect for name, dialect in registry.kinds(DIALECTS).items() if dialect.recognises(path)}
    if len(known) > 1:
        raise InputError(f"{path}: expected a probe's calibration of one dialect, found {' and '.join(known)}")
    return next(iter(known.values()), own_probe).read(path, speed_m_s)
