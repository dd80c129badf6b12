"""Ranges of a tracking sample's random parameters; `conf/dataset.yaml` gives each its reason."""

from typing import Annotated

from pydantic import Field, model_validator

from recon.model.rig import Fraction, NotNegative, Part, Positive

Share = Fraction


class Ranges(Part):
    """Base: immutable, refuses unknown keys, and every pair is (least, most)."""

    @model_validator(mode="after")
    def _ordered(self) -> "Ranges":
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
                raise ValueError(f"{name}: expected the least first, found {list(value)}")
        return self


Lengths = tuple[Positive, Positive]


class CameraRanges(Ranges):
    """Ranges of calibrations, from rig to rig."""

    own_share: Share  # of samples with the rig's own cameras, exactly
    focal_px: Lengths  # in images as wide as those that the networks know; in others in proportion
    centre_px: NotNegative  # standard deviation of the principal point from the image's middle
    distortion: NotNegative  # scale of k1; the rest follows
    baseline_mm: Lengths
    converge_mm: Lengths  # distance at which the optical axes meet
    blur_px: Lengths  # standard deviation of the point spread in focus
    f_number: Lengths
    focus_mm: Lengths


class PoseRanges(Ranges):
    """Where the target is and how it moves."""

    empty_share: Share  # of samples without target
    working_share: Share  # of targets within the working distances
    working_mm: Lengths
    distance_mm: Lengths  # of the rest
    tilt_deg: Annotated[float, Field(gt=0, lt=80)]  # most, between the target's normal and the way to the cameras
    still_share: Share  # of targets that hardly move
    blur_px: Lengths  # path of the target in the image over the exposure, log-uniform
    swing: NotNegative  # angular part: path of the outer circles about the middle, relative to the middle's


class LightRanges(Ranges):
    """Ranges of light and exposure."""

    white_dn: Lengths  # of 255: brightness of the target's white, log-uniform; past 255 it saturates
    ordinary_share: Share  # of samples within ordinary_dn instead
    ordinary_dn: Lengths
    lamps: tuple[Annotated[int, Field(ge=1, le=4)], Annotated[int, Field(ge=1, le=4)]]
    lamp_mm: Lengths  # distance from the target
    lamp_radius_mm: Lengths  # makes shadows soft
    ambient: tuple[Fraction, Fraction]  # share of the light that comes from all around
    projector_share: Share  # of samples that the projector lights
    projector: Lengths  # its light relative to the lamps'
    gain: Lengths  # of the sensor; more gain, fewer electrons a digital number
    dark_noise_e: Lengths


class TargetRanges(Ranges):
    """Ranges of the targets' print, wear and cover."""

    ink: tuple[Fraction, Fraction]  # reflectance
    paper: tuple[Fraction, Fraction]
    flaw_share: Share  # of targets with scratches, dirt and uneven ink


class BodyRanges(Ranges):
    """Ranges of the bodies of a rig that has several."""

    absent_share: Share = 0.2  # of each body, the probe too, in samples that aren't empty
    apart_mm: Positive = 120.0  # most, by which one in a hand is nearer to the cameras than the probe, or farther


class DataRanges(Ranges):
    """All ranges of a data set."""

    variants: Annotated[int, Field(ge=1, le=64)]  # of held bodies and of surroundings, each, in one data set
    cameras: CameraRanges
    pose: PoseRanges
    light: LightRanges
    target: TargetRanges
    bodies: BodyRanges = BodyRanges()
