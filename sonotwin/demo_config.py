"""Settings of a demonstration: its fields, and its constants."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PrivateAttr, model_validator

from recon.model.probe import Speed
from recon.model.rig import Positive
from scenes.acoustics import made_of
from sonotwin.verbs import render
from twin.optics import surface_session
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer, check_scanner

CALIBRATION = "calibration"  # folder
BOARD_PATTERNS = "paper_calibration"
WATER_C = 22.0  # of the tank, as `scenes.acoustics` has it
TUMOURS = "tumour"  # what the things are called that ultrasound looks for


class Config(render.Config):
    """Fields of `conf/demo.yaml`: those of `conf/render.yaml`, for one camera, but the poses are of another scene, the board;
    and those of `conf/sweep.yaml`.
    """

    cameras: Annotated[list[surface_session.CameraName], Field(min_length=1, max_length=1)]
    board: Path
    ultrasound: Transducer
    path: AnyPath | None
    clocks: Clocks = Clocks(camera_hz=16.0)
    wires: Annotated[int, Field(ge=1, le=1000)] = 40
    bottom_s: Positive = 5.0
    tissue_m_s: Speed = 1450.0
    film_frames: Annotated[int, Field(ge=0, le=10_000)] = 24
    _overrides: Sequence[str] = PrivateAttr(())  # field=value as they were given

    @model_validator(mode="after")
    def _fits_poses(self) -> "Config":
        # in place of render's check of that name: here poses are of the board, rendered by itself, and the scene is another
        return self

    @model_validator(mode="after")
    def _shows_fringes(self) -> "Config":
        if not self.patterns.has_fringes(self.patterns.axes[0]):
            raise ValueError("patterns: expected fringes, whose phase the page shows, found Gray code alone")
        return self

    @model_validator(mode="after")
    def _one_scanner(self) -> "Config":
        check_scanner(self.rig, self.ultrasound)
        return self

    @property
    def looks_inside(self) -> bool:
        """Whether there is a sweep: a path was given, and there is something to find."""
        return self.path is not None and TUMOURS in made_of(str(self.scene["kind"]))

    def model_post_init(self, context: Any) -> None:
        """Keep the overrides, which the steps pass on to their verbs."""
        if context:
            self._overrides = context["overrides"]
