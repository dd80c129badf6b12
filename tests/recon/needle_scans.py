"""B-scans of a needle by the twin's scanner: a rod of steel in water or tissue that ends in the image."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scenes.acoustics import TISSUES
from scenes.handheld.shaft import Shaft
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body, Wire
from twin.ultrasound.tool_echoes import Tool
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

RADIUS_MM = 0.6
WATER = Transducer(tgc_db_per_cm_mhz=0.0165, gain_db=-40.0)  # as conf/ultrasound/water.yaml
SCANNERS = {"water": WATER, "gelatin": Transducer(), "silicone": Transducer()}
SCALE = np.array(WATER.scale_mm_per_px)


def rod(tip_mm, dip_deg: float, yaw_deg: float = 0.0, side: int = 1, length_mm: float = 60.0) -> Wire:
    """A needle's shaft to a tip in the image's frame, from the left (side 1) or the right, down and out of the plane."""
    dip, yaw = np.radians([dip_deg, yaw_deg])
    along = np.array([side * np.cos(dip) * np.cos(yaw), np.sin(dip) * np.cos(yaw), np.sin(yaw)])
    ends = np.array([tip_mm - length_mm * along, tip_mm])
    return Wire("needle", replace(TISSUES["steel"], roughness=0.02), ends, RADIUS_MM)


def image(medium: str, *wires: Wire, seed: int = 0) -> NDArray[np.uint8]:
    """The B-scan : (h, w) in the world's x-y plane."""
    return scan(Body(TISSUES[medium], (), wires), SCANNERS[medium], np.eye(4), seed).image


def echo_of(tip_mm, medium: str) -> Array:
    """Pixel : (2,) at which the front of a tip is shown."""
    ratio = SCANNERS[medium].assumed_speed / TISSUES[medium].speed
    return np.array([tip_mm[0], (tip_mm[1] - RADIUS_MM) * ratio]) / SCALE


def bevelled(tip_mm, dip_deg: float, angle_deg: float = 17.0) -> NDArray[np.uint8]:
    """The B-scan : (h, w) of a needle with a ground tip in water, from the left, the bevel open to the probe."""
    dip = np.radians(dip_deg)
    along, up = np.array([np.cos(dip), np.sin(dip), 0.0]), np.array([np.sin(dip), -np.cos(dip), 0.0])
    steel = replace(TISSUES["steel"], roughness=0.001)
    shaft = Shaft(np.asarray(tip_mm), along, up, 60.0, 0.735, steel, kind="bevel", angle=np.radians(angle_deg))
    return scan(Body(TISSUES["water"], (), ()), WATER, np.eye(4), 0, 0, (Tool(shaft),)).image
