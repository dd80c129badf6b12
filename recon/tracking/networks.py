"""The tracker's two networks, run by ONNX Runtime."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as runtime  # pyrefly: ignore[missing-module-attribute]

from recon.errors import InputError, reason
from recon.files.regular import read_bytes
from recon.model import circle_layout
from recon.model.rig import Target

Floats = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights"
DETECTOR_SIZE = (320, 240)  # width, height, px
MOST_BYTES = 1 << 28  # of a network
TRAINED_FOR = "target"  # of a network's metadata: the kind of target; older files have none, and are of three circles
THREE_CIRCLES = "three_circles"
CELL = 8  # px, of the detector's output
PATCH = 120  # px
Interface = tuple[dict[str, tuple[int | None, ...]], dict[str, tuple[int | None, ...]]]

DETECTOR: Interface = ({"image": (None, 1, 240, 320)}, {"detection": (None, 65, 30, 40), "identity": (None, None, 30, 40)})
SEGMENTER: Interface = ({"patch": (None, 1, PATCH, PATCH)}, {"mask": (None, 1, PATCH, PATCH)})
FAULTS = (runtime.InvalidProtobuf, runtime.InvalidGraph, runtime.InvalidArgument, runtime.Fail, runtime.NotImplemented,
          runtime.NoModel, runtime.NoSuchFile, runtime.RuntimeException)  # fmt: skip


class Networks(Protocol):
    """Whatever detects circles in a frame and segments them in patches."""

    def detect(self, images: Floats) -> tuple[Floats, Floats]:
        """Images : (n, 240, 320) of 0 to 1, to logits of places : (n, 65, 30, 40) and of identities : (n, circles + 1, 30, 40).

        Of the latter the last one is that of no circle.
        """
        ...

    def segment(self, patches: Floats) -> Floats:
        """Patches : (n, 120, 120) of 0 to 1, to logits : (n, 120, 120) of the disc nearest to each one's middle."""
        ...


@dataclass(frozen=True)
class OnnxNetworks:
    """Both networks, loaded."""

    detector: onnxruntime.InferenceSession
    segmenter: onnxruntime.InferenceSession
    unnamed: int | None = None  # circles of a target of which the detector doesn't know the names: all are as likely

    def detect(self, images: Floats) -> tuple[Floats, Floats]:
        """See `Networks`."""
        detection, identity = self.detector.run(list(DETECTOR[1]), {"image": np.ascontiguousarray(images[:, None], np.float32)})
        if self.unnamed is not None:
            identity = np.zeros((len(images), self.unnamed + 1, *np.shape(detection)[2:]), np.float32)
        return np.asarray(detection), np.asarray(identity)

    def segment(self, patches: Floats) -> Floats:
        """See `Networks`."""
        return np.asarray(self.segmenter.run(["mask"], {"patch": np.ascontiguousarray(patches[:, None], np.float32)})[0])[:, 0]


def load(
    folder: Path = WEIGHTS, threads: int = 0, kind: str = THREE_CIRCLES, by_geometry: bool = False, way: str = ""
) -> OnnxNetworks:
    """Load `detector.onnx` and `segmenter.onnx`, to run on `threads` cores, 0 for all.

    Parameters
    ----------
    kind : of target that is to be found, a module of `recon.model.targets`
    by_geometry : whether the detector's names of circles don't count, as one's of another kind of target
    way : out of the refusal of another kind of target, for the message

    Raises
    ------
    InputError
        If a file is missing, isn't a network, is another one, or was trained for another kind of target.
    """
    detector, segmenter = (Path(folder) / name for name in ("detector.onnx", "segmenter.onnx"))
    found, circles = session(detector, DETECTOR, threads), circle_layout.count(Target.named(kind))
    trained = found.get_modelmeta().custom_metadata_map.get(TRAINED_FOR, THREE_CIRCLES)
    if not by_geometry and trained != kind:
        found_one = f"found one of {trained}" + (f"; {way}" if way else "")
        raise InputError(f"{detector}: expected a detector of {kind}, as rig.target is, {found_one}")
    named = {node.name: node.shape[1] for node in found.get_outputs()}["identity"]
    if not by_geometry and isinstance(named, int) and named != circles + 1:
        raise InputError(f"{detector}: expected {circles + 1} identities of {kind}, found {named}")
    return OnnxNetworks(found, session(segmenter, SEGMENTER, threads), circles if by_geometry else None)


def session(path: Path, interface: Interface, threads: int = 0) -> onnxruntime.InferenceSession:
    """Open a network, and check that it takes and gives what is expected."""
    network = read_bytes(path, MOST_BYTES, "a network")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 4
    # threads that wait by spinning would take the cores from the fit of rims that follows: 75 ms from nothing instead of 41
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        opened = onnxruntime.InferenceSession(network, options, ["CPUExecutionProvider"], enable_fallback=0)
        inputs, outputs = (
            {node.name: tuple(node.shape) for node in some} for some in (opened.get_inputs(), opened.get_outputs())
        )
    except (*FAULTS, ValueError) as error:  # the latter of texts in it
        raise InputError(f"{path}: expected an ONNX network, found {reason(error)}") from None
    for what, expected, shapes in (("inputs", interface[0], inputs), ("outputs", interface[1], outputs)):
        if not all(name in shapes and _fits(shapes[name], shape) for name, shape in expected.items()) or (
            what == "inputs" and len(shapes) != len(expected)
        ):
            raise InputError(f"{path}: {what}: expected {_listed(expected)}, found {_listed(shapes)}")
    return opened


def _fits(found: tuple[object, ...], expected: tuple[int | None, ...]) -> bool:
    """Whether all sizes that the file fixes are as expected; names stand for any."""
    return len(found) == len(expected) and all(
        not isinstance(a, int) or b is None or a == b for a, b in zip(found, expected, strict=True)
    )


def _listed(shapes: dict) -> str:
    sizes = {name: "x".join("n" if size is None else str(size) for size in shape) for name, shape in shapes.items()}
    return ", ".join(f"{name} ({size})" for name, size in sizes.items())
