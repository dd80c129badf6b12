"""Certify a rig: an acceptance test by spheres, a ball bar, a plane, divots and filaments, with uncertainties and decisions.

Reads a folder with the folders sphere, bar and plane; each has a capture a place (00, 01, ...), as `sonotwin record` or
`sonotwin render-artefacts` writes it, or a mesh in mm by any scanner. Of a plate with divots the folder divots has a table of a
tracked tool's poses a divot, as `sonotwin track` writes it; of a phantom with filaments the folder filaments has a folder of
B-scans (PNG) a setting. Reads the artefacts' certificates and the maximum permissible errors, two YAML files to be copied and
edited: conf/artefacts/steel.yaml, conf/limits/meza2021.yaml. No ground truth.
Writes into the folder `out` certificate.html and certificate.pdf, to be signed, and certificate.json, with all budgets. The
quantities are those of VDI/VDE 2634-2/3 and ISO 10360-13: probing errors of form and size, sphere-spacing error, length
measurement error, flatness measurement error; of a tracked tool repeatability and error of distances, in kind as in ASTM F2554;
of a scanner callipers and widths of echoes, in kind as in IEC 61391-1. Uncertainties are by the GUM, with Monte Carlo beside
them, decisions by ISO 14253-1. Exit status 1 if the rig is rejected, or neither accepted nor rejected. Takes some seconds a
capture.

    sonotwin render-artefacts out=outputs/acceptance
    sonotwin certify capture=outputs/acceptance out=outputs/certificate
    sonotwin certify capture=outputs/tool artefacts=divot_plate tip=outputs/tip/tip.yaml out=outputs/tool_certificate
    sonotwin certify capture=outputs/scanner artefacts=filaments out=outputs/scanner_certificate
    sonotwin certify capture=outputs/acceptance artefacts=steel limits.sd_mm=0.05 operator="A. Meter" out=outputs/stricter
"""

from pathlib import Path

from recon.session import acceptance_step
from sonotwin.console_watch import ConsoleWatch


class Config(acceptance_step.Settings):
    """Fields of `sonotwin certify`."""

    out: Path
    """folder; gets certificate.html, certificate.pdf and certificate.json"""


def run(config: Config) -> int:
    """Read, fit, judge and write; returns 1 unless the rig is accepted; raises InputError as `acceptance_step.run`."""
    found = acceptance_step.run(config, config.out, ConsoleWatch())
    return int(any(one.decision is not None for one in found.values) and found.decision != "accepted")
