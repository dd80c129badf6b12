"""The shipped detector, trained further on frames of the identified twin, of the usual rig or of the true one, tried on the last.

The rig is drawn at random and identified from its own captures. Its laboratory has a light and a speed of the hand, which any
film shows: narrow sets have these, the twin's own cameras and no gain; wide ones have the ranges of conf/dataset.yaml as they
are. Frames that are tried are narrow ones, of bodies and surroundings that no set has. Each trial has bodies, surroundings and
crops of its own, the same for each twin.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from recon.files.metrics import Metrics
from recon.model.rig import Rig
from recon.session import rig_step
from twin.conditions import Conditions
from twin.experiments import drawn_rig
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.identify_trial import record_optics
from twin.shooting import Quality
from twin.tracking import dataset_shards
from twin.tracking.sampling_ranges import DataRanges

SAMPLES, TRIED = 24, 40  # stereo pairs of a set, and of those that are tried
VARIANTS = 6  # of bodies and surroundings
QUALITY = Quality(view=1, patch=2)  # patches aren't used
STEPS = 30  # of a training
TRAININGS = 2  # of each set, by other crops in another order
SCALES = {"wide": (0.5, 1.6), "narrow": (0.9, 1.1)}  # of a training's views: as usual, and as those that are tried
FIGURES = ("loss", "missed", "missed_targets", "centre_px")
FAR_MM = 660.0  # where the hand's way is seen as long as it is said
WHITE_DN, WAY_MM = (15.0, 120.0), (0.3, 3.0)  # of laboratories, the hand's way over an exposure at most


class Laboratory(NamedTuple):
    """Light and motion of a laboratory's frames."""

    white_dn: float  # of the target's white
    way_mm: float  # of the target over an exposure, at most

    def narrowed(self, ranges: DataRanges, rig: Rig) -> DataRanges:
        """Ranges of frames by a rig's own cameras, without gain, in this light and motion."""
        cameras = ranges.cameras.model_copy(update={"own_share": 1.0})
        most_px = self.way_mm * rig.cam1.optics.focal_px[0] / FAR_MM
        pose = ranges.pose.model_copy(update={"working_share": 1.0, "blur_px": (0.1 * most_px, most_px)})
        about = {"ordinary_share": 1.0, "ordinary_dn": (self.white_dn / 1.2, self.white_dn * 1.2)}
        light = ranges.light.model_copy(update={**about, "projector_share": 0.0, "gain": (1.0, 1.0)})
        return ranges.model_copy(update={"cameras": cameras, "pose": pose, "light": light})


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures on the true rig's frames after training on each twin's, means over trainings, and gains of the identified twin."""
    from trainers import short_training  # torch takes seconds to import, and isn't there without the extra `train`

    ranges = settings.ranges.model_copy(update={"variants": VARIANTS})
    rig, conditions = drawn_rig.draw(settings.rig, seed)
    laboratory = draw_laboratory(seed)
    found = {}
    with TemporaryDirectory() as named:
        out = Path(named)
        found_rig = identified(rig, conditions, out, settings.poses.seed + seed, seed)
        tried = rendered(rig, laboratory.narrowed(ranges, rig), TRIED, 2 * seed + 1, out / "tried")
        for name, twin in {"usual": settings.rig, "identified": found_rig, "true": rig}.items():
            for how, chosen in {"wide": ranges, "narrow": laboratory.narrowed(ranges, twin)}.items():
                learnt = rendered(twin, chosen, SAMPLES, 2 * seed, out / f"{name}_{how}")
                crops = range(seed * TRAININGS, (seed + 1) * TRAININGS)
                trained = [short_training.trained_on(learnt, STEPS, k, SCALES[how]) for k in crops]
                found[how, name] = [short_training.figures(network, tried) for network in trained]
        shipped = short_training.figures(short_training.shipped(), tried)
    before = {f"{figure}_shipped": value for figure, value in shipped.items()}
    return judge(found) | before | laboratory._asdict() | {"width_px": rig.cam1.optics.size[0]}


def draw_laboratory(seed: int) -> Laboratory:
    """Draw light and motion, as many in each octave."""
    rng = np.random.default_rng([seed, 63])
    white, way = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (WHITE_DN, WAY_MM))
    return Laboratory(white, way)


def identified(rig: Rig, conditions: Conditions, out: Path, poses_seed: int, seed: int) -> Rig:
    """Identify cameras and projector from captures that are recorded in a folder, and the rig's sheet."""
    return rig_step.identify(rig_step.Settings(**record_optics(rig, conditions, out, poses_seed, seed))).rig


def rendered(rig: Rig, ranges: DataRanges, samples: int, seed: int, out: Path) -> Path:
    """Render a data set into a folder."""
    chosen = dataset_shards.Settings(
        rig=rig, ranges=ranges, quality=QUALITY, frames="views", seed=seed, samples=samples, shard=samples
    )
    place = dataset_shards.Place(out)
    for number in dataset_shards.prepare(place, chosen):
        dataset_shards.write_shard(place, chosen, number)
    return out


def judge(found: dict[tuple[str, str], list[Metrics]]) -> Metrics:
    """Means of the trainings on each set, and the usual rig's less the identified's, and that less the true's."""
    means = {(figure, *key): float(np.mean([one[figure] for one in some])) for key, some in found.items() for figure in FIGURES}
    figures: Metrics = {f"{figure}_{name}_{how}": value for (figure, how, name), value in means.items()}
    for figure in FIGURES:
        for how in SCALES:
            usual, identified, true = (means[figure, how, name] for name in ("usual", "identified", "true"))
            figures |= {f"{figure}_gain_{how}": usual - identified, f"{figure}_left_{how}": identified - true}
    spread = [np.var([one["loss"] for one in some], ddof=1) for some in found.values()]
    return figures | {"loss_between_trainings": float(np.sqrt(np.mean(spread)))}


EXPERIMENT = Experiment(
    ("rig", "poses", "ranges"),
    measure,
    {
        f"{figure}_{name}_{how}": f"{figure}_true_{how}"
        for figure in ("loss", "missed")
        for how in SCALES
        for name in ("usual", "identified")
    },
    "trained on the true rig's frames",
    packages=("trainers",),
    libraries=("torch", "kornia", "lightning-fabric"),
)
