"""Render a data set of tracking frames with ground truth: a held probe and its target in any light, still or moving.

Reads the ranges of what is drawn at random from conf/dataset.yaml. Writes OUT/shard-*.tar (WebDataset), OUT/index.parquet and
OUT/dataset.json; docs/training.md says what is in them. About six stereo samples a second on two cores, after a minute in which
it compiles. A run that was stopped goes on where it was when started again; the same seed gives the same bytes, on any engine.
Several machines make ranges of one set, each into a folder of its own from its sample `first` on; `sonotwin train data=[a,b]`
takes them together. A second run into one folder is refused while the first is at work.
With a rig that has further bodies, such as three_bodies, samples hold them too, each with its truth.

    sonotwin dataset out=outputs/data samples=3000 engine.workers=2
    sonotwin dataset out=outputs/test samples=1000 seed=1
    sonotwin dataset out=outputs/more first=3000 samples=3000
    sonotwin dataset out=outputs/full samples=20 frames=full
    sonotwin dataset out=outputs/bodies rig=three_bodies
"""

from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.progress import Progress

from recon.files.occupied import occupied
from recon.model.rig import Rig
from sonotwin.console_watch import LineConsole
from twin.engine import Engine
from twin.shooting import Quality
from twin.tracking.dataset_shards import Place, Settings, generate, prepare, write_index
from twin.tracking.sampling_ranges import DataRanges


class Config(BaseModel):
    """Fields of `conf/dataset.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    out: Path
    first: Annotated[int, Field(ge=0, le=1_000_000_000)] = 0
    samples: Annotated[int, Field(ge=1, le=10_000_000)]
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    frames: Literal["views", "sketches", "full"] = "views"
    shard: Annotated[int, Field(ge=1, le=10_000)] = 50
    quality: Quality = Quality()
    ranges: DataRanges
    engine: Engine = Engine()

    def settings(self) -> Settings:
        """Settings that the bytes depend on."""
        return Settings(**self.model_dump(exclude={"out", "engine"}))


def run(config: Config) -> None:
    """Render the samples that are missing, write the index of all, and print the pace.

    Raises
    ------
    InputError
        If `out` holds anything but a data set of these settings, or another run is writing there.
    """
    with occupied(config.out):
        _make(config, LineConsole())


def _make(config: Config, console: Console) -> None:
    place, settings = Place(config.out), config.settings()
    missing = prepare(place, settings)
    total = sum(len(settings.samples_of(number)) for number in missing)
    if total < config.samples:
        console.print(f"found       {config.samples - total} samples")
    start = perf_counter()
    with (
        Progress(console=console, transient=True, disable=not console.is_terminal) as progress,
        closing(generate(place, settings, missing, config.engine)) as counts,
    ):
        task = progress.add_task("rendering samples", total=total)
        for count in counts:
            progress.advance(task, count)
    if total:
        seconds = perf_counter() - start
        console.print(f"render      {total} stereo samples, {total / seconds:.2f} a second")
    write_index(place, settings)
    console.print(f"wrote       {config.out}/{{shard-*.tar,index.parquet,dataset.json}}", markup=False)
