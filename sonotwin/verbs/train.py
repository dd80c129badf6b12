"""Train a network of the tracker: the detector, which finds circles in a view, or the segmenter, which outlines one in a patch.

`network=masses` trains the one that tells masses from tissue in B-scans, with sweeps and their truth as of `sonotwin sweep`, or
with images and outlines.csv, all in memory; docs/training.md tells how.

Reads data sets as of `sonotwin dataset`, one or several: ranges of one, or of other seeds; and folders of MarkerPose's training
data (data_centers.csv with images/, patch120/ with mask120/), which come after these. Their images are decoded into memory,
150 kB a sample for a detector and 170 kB for a segmenter, or read from the shards as they are needed where that is more than
`memory_gb`; the training is the same either way. Writes into the folder `out`: the network as ONNX for the tracker, its weights
as .safetensors and .pt with the published names, metrics.json of the validation samples, the curves as log.jsonl and curves.png,
and checkpoint.pt, from which the same command goes on if it was interrupted. A second run into one folder is refused while the
first is at work. Needs the extra `train`. On one core the networks of ours take some 40 crops or 100 patches a second, and need
half an hour to some hours; the published ones take 6 to 20 times as long.

    sonotwin train network=detector data=outputs/dataset out=outputs/detector max_minutes=60
    sonotwin train network=published_segmenter data=outputs/dataset out=outputs/segmenter steps=20000 threads=1
    sonotwin train network=segmenter data=outputs/dataset validation_data=theirs out=outputs/segmenter steps=5500
    sonotwin train network=detector data=[outputs/first,outputs/second] out=outputs/detector max_minutes=600 memory_gb=8
    sonotwin train network=detector data=outputs/more init=outputs/detector/detector.safetensors out=outputs/detector2 steps=5000
    sonotwin train network=masses data=outputs/patients out=outputs/masses max_minutes=30
"""

import json
from pathlib import Path
from typing import Annotated

import torch
from matplotlib.figure import Figure
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from rich.console import Console
from rich.progress import Progress

from recon import cores
from recon.errors import InputError, short
from recon.files import atomic, json_text, metrics
from recon.files.metrics import Metrics, shown
from recon.files.occupied import occupied
from recon.model import circle_layout
from recon.model.rig import Target
from sonotwin.console_watch import LineConsole
from sonotwin.folder_lists import Folders, listed
from trainers import data_sets, export, fit, free_memory, scan_reader, shard_reader
from trainers.architectures import Name, is_detector, network
from trainers.batches import SCALES
from trainers.checkpoints import TRAIN
from trainers.fit import Fitted, Plan, Precision
from trainers.scan_reader import Scans
from trainers.shard_reader import Data
from trainers.stored_images import StoredImages

CURVES = "curves.png"
MARKER = "training.json"  # what a run was asked for
MAY_CHANGE = {"out", "resume", "steps", "max_minutes", "checkpoint_minutes"}  # when a run goes on
MAY_CHANGE |= {"threads", "loaders", "memory_gb"}  # which change no batch
LISTS = ("data", "validation_data")  # of folders; one may be given by itself
LONGEST_FIELD = 300  # letters, of a value that a message asks for, such as folders
MEMORY_SHARE = 0.5  # of what is free, for images, if memory_gb isn't given


SomeFolders = Annotated[Folders, Field(min_length=1)]


Scale = Annotated[float, Field(ge=0.1, le=4)]


class Config(BaseModel):
    """Fields of `conf/train.yaml`."""

    model_config = ConfigDict(extra="forbid")

    network: Name
    data: SomeFolders
    out: Path
    steps: Annotated[int, Field(ge=1)] | None = None
    max_minutes: Annotated[float, Field(gt=0, le=100_000)] | None = None
    init: Path | None = None
    resume: bool = True
    partial: bool = False
    validation_data: SomeFolders | None = None
    validation: Annotated[float, Field(gt=0, lt=1)] = 0.05
    batch: Annotated[int, Field(ge=2, le=4096)] | None = None
    crop_px: Annotated[int, Field(ge=64, le=240, multiple_of=8)] = 160
    scales: tuple[Scale, Scale] = SCALES
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 0.002
    weight_decay: Annotated[float, Field(ge=0, le=1)] = 0.01
    precision: Precision = "auto"
    threads: Annotated[int, Field(ge=1, le=1024)] | None = None
    loaders: Annotated[int, Field(ge=0, le=1024)] = 0
    memory_gb: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    checkpoint_minutes: Annotated[float, Field(gt=0, le=100_000)] = 5.0
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    @model_validator(mode="after")
    def _ends(self) -> "Config":
        if self.steps is None and self.max_minutes is None:
            raise ValueError("expected steps or max_minutes, found neither")
        return self

    @model_validator(mode="after")
    def _all_change_something(self) -> "Config":
        """Refuse fields that change nothing of a network that trains with whole B-scans in memory."""
        for name in ("crop_px", "scales", "memory_gb") if self.network == "masses" else ():
            if (found := getattr(self, name)) != type(self).model_fields[name].default:
                raise ValueError(f"{name}: expected none for network=masses, which trains with whole B-scans, found {found}")
        return self

    @field_validator("data", "validation_data", mode="before")
    @classmethod
    def _named(cls, given: object) -> object:
        """Refuse a variable of the shell that is empty: it would be the folder in which the command is run."""
        if "" in (given if isinstance(given, list | tuple) else [given]):
            raise ValueError("expected a folder, found an empty name")
        return given

    @field_validator("scales")
    @classmethod
    def _least_first(cls, given: tuple[float, float]) -> tuple[float, float]:
        if given[0] > given[1]:
            raise ValueError(f"expected the least first, found {list(given)}")
        return given

    @property
    def memory(self) -> float:
        """Bytes that decoded images may take."""
        return MEMORY_SHARE * free_memory.free_bytes() if self.memory_gb is None else 1e9 * self.memory_gb

    @property
    def plan(self) -> Plan:
        """Settings of the training loop."""
        batch = self.batch or (8 if self.network.startswith("published") else 16)
        return Plan(
            self.network,
            batch,
            self.crop_px,
            self.learning_rate,
            self.weight_decay,
            self.seed,
            self.steps,
            self.max_minutes,
            self.checkpoint_minutes,
            precision=self.precision,
            loaders=self.loaders,
            scales=self.scales,
        )


def run(config: Config) -> None:
    """Train, measure and write.

    Raises
    ------
    InputError
        If the data set or the weights to start from are missing, damaged or others, or `out` can't be written to.
    KeyboardInterrupt
        If it was stopped; a checkpoint is there then.
    """
    inputs = [*config.data, *(config.validation_data or ()), *([config.init] if config.init else ())]
    atomic.check_filled_folder(config.out, TRAIN, inputs=inputs)
    for name in [MARKER, *names_of(config)]:
        atomic.check_listed(config.out, name, TRAIN)
    with occupied(config.out):
        _train(config, LineConsole())


def _train(config: Config, console: Console) -> None:
    goes_on = check_resumed(config)
    torch.set_num_threads(config.threads or cores.usable())
    torch.manual_seed(config.seed)
    kind = "" if config.network == "masses" else shard_reader.kind_of([*config.data, *(config.validation_data or ())])
    module = network(config.network, circle_layout.count(Target.named(kind)) if kind else 0)
    if config.init is not None:
        export.load(config.init, module)
    train, validation = read(config, console)
    prepare(config, goes_on)
    fitted = fitted_with_progress(config, module, train, validation, console)
    since = f", from step {fitted.resumed_at} on" if fitted.resumed_at else ""
    weights = sum(value.numel() for value in module.parameters())
    console.print(
        f"train       {weights} weights, {fitted.steps} steps of {config.plan.batch}, {fitted.seconds / 60:.1f} min{since}"
    )
    with console.status("measuring"):
        figures = fit.measure(fitted.network, validation)
    console.print(f"validate    {describe(figures)}", markup=False)
    with console.status("writing"):
        write(config, fitted, figures, kind)
    console.print(f"wrote       {config.out}/{{{','.join(names_of(config))}}}", markup=False)


def check_resumed(config: Config) -> bool:
    """Whether a run goes on from a checkpoint in `out`; InputError if that one was asked for something else."""
    marker, checkpoint = config.out / MARKER, config.out / fit.CHECKPOINT
    if not config.resume or not checkpoint.is_file():
        return False
    try:
        before = json_text.read(marker)
        before |= {name: listed(before[name]) for name in LISTS}  # runs of earlier versions had one folder
        differing = [name for name, value in settings(config).items() if name not in MAY_CHANGE and before[name] != value]
        expected = [f"{name}={given(before[name])}" for name in differing]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(
            f"{marker}: expected a training's settings, found other or damaged data; resume=false starts anew"
        ) from None
    if expected:
        raise InputError(f"{config.out}: expected {expected[0]} as its checkpoint has, or resume=false to start anew")
    fit.read_log(config.out)  # a damaged one is refused before anything is done
    return True


def given(value: object) -> str:
    """A field's value in the command's own words, where they are short."""
    values = value if isinstance(value, list) else [value]
    return short(str(values[0]) if len(values) == 1 else f"[{','.join(map(str, values))}]", LONGEST_FIELD)


def settings(config: Config) -> dict:
    """The request as JSON; folders by their whole paths."""
    paths = {name: str(path.resolve()) for name in ("out", "init") if (path := getattr(config, name))}
    lists = {name: [str(path.resolve()) for path in some] for name in LISTS if (some := getattr(config, name))}
    return config.model_dump(mode="json") | paths | lists


def prepare(config: Config, goes_on: bool) -> None:
    """Make the folder, without what an earlier run left if this one starts anew."""
    atomic.begin_filled(config.out, TRAIN)
    for name in [MARKER, *names_of(config)]:
        atomic.remove_leftovers(config.out / name)
    if not goes_on:
        atomic.remove_listed(config.out, (fit.CHECKPOINT, fit.LOG, metrics.FILE, CURVES), TRAIN)
    with atomic.listed_file(config.out, MARKER, TRAIN) as temporary:
        temporary.write_text(json.dumps(settings(config), indent=2) + "\n", encoding="utf-8")


def read(config: Config, console: Console) -> tuple[Data, Data]:
    """Training and validation samples, in memory as far as they may be."""
    reader, what = data_sets.read_patches, "patches"
    if is_detector(config.network):
        reader, what = data_sets.read_views, "views"
    elif config.network == "masses":
        reader, what = scan_reader.read_scans, "B-scans"
    with console.status("reading") as status:
        data = reader(config.data, lambda count: status.update(f"reading, {count} samples"), config.partial)
        if config.validation_data is not None:
            sets = data, reader(config.validation_data)
        else:
            sets = shard_reader.split(data, config.validation)
        if isinstance(sets[0], Scans) and not len(sets[0].shows):
            names = "labels mass0, solid0, tumour0 ..., or masks"
            raise InputError(f"data: expected masses to train with, as of {names}, found none in {len(sets[0])} B-scans")
        memory = config.memory
        train, validation = shard_reader.as_fits(sets, memory, lambda count: status.update(f"decoding, {count} images"))
    console.print(f"read        {len(train)} {what} to train with, {len(validation)} to validate with", markup=False)
    if isinstance(train.images, StoredImages):
        needed = shard_reader.bytes_decoded(train) / 1e9
        console.print(f"stream      from the shards: {needed:.2g} GB of images, memory for {memory / 1e9:.2g} GB", markup=False)
    return train, validation


def fitted_with_progress(config: Config, module: torch.nn.Module, train: Data, validation: Data, console: Console) -> Fitted:
    """Train, and show the progress."""
    with Progress(console=console, transient=True, disable=not console.is_terminal) as display:
        task = display.add_task("training", total=1.0)

        def tell(step: int, done: float, loss: float) -> None:
            display.update(task, completed=done, description=f"training, step {step}, loss {loss:.3f}")

        return fit.fit(module, train, validation, config.plan, config.out, tell)


def describe(figures: Metrics) -> str:
    """One line with the network's figures of merit."""
    if "recall" in figures:
        return (
            f"{shown(100 * figures['recall'], '.1f', ' %')} of circles found with their identity, "
            f"{shown(100 * figures['all_three'], '.1f', ' %')} of views with all circles, "
            f"median {shown(figures['place_median_full_px'], '.2f', ' px')} off in full resolution, "
            f"{shown(figures['false_per_empty_view'], '.2f')} false circles an empty view"
        )
    if "iou_pixels" in figures:
        return (
            f"IoU {shown(figures['iou'], '.3f')}, {shown(100 * figures['missed'], '.1f', ' %')} of B-scans with a mass missed, "
            f"{shown(100 * figures['empty_right'], '.1f', ' %')} of empty ones right"
        )
    return (
        f"IoU {shown(figures['iou'], '.3f')}, centres {shown(figures['centre_median_px'], '.2f', ' px')} off, "
        f"{shown(100 * figures['missed'], '.1f', ' %')} missed, "
        f"{shown(100 * figures['empty_right'], '.1f', ' %')} of empty ones right"
    )


def names_of(config: Config) -> list[str]:
    """Names of the files that a training writes, its settings apart."""
    weights = [weights_file(config, suffix).name for suffix in (".onnx", ".safetensors", ".pt")]
    return [*weights, metrics.FILE, CURVES, fit.LOG, fit.CHECKPOINT]


def weights_file(config: Config, suffix: str) -> Path:
    """The file of the trained network, of one kind."""
    return (config.out / config.network.removeprefix("published_")).with_suffix(suffix)


def write(config: Config, fitted: Fitted, figures: Metrics, kind: str) -> None:
    """Write the network for a kind of target, its figures and curves."""
    with atomic.listed_file(config.out, weights_file(config, ".onnx").name, TRAIN) as temporary:
        export.save_onnx(temporary, fitted.network, config.network, kind)
    for suffix in (".safetensors", ".pt"):
        with atomic.listed_file(config.out, weights_file(config, suffix).name, TRAIN) as temporary:
            export.save(temporary, fitted.network)
    with atomic.listed_file(config.out, metrics.FILE, TRAIN) as temporary:
        metrics.write(temporary, figures | {"steps": fitted.steps, "seconds_train": round(fitted.seconds, 1)})
    with atomic.listed_file(config.out, CURVES, TRAIN) as temporary:
        curves(fit.read_log(config.out)).savefig(temporary, dpi=120)


def curves(rows: list[fit.Row]) -> Figure:
    """Loss and validation figures over the steps."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, names in ((left, ("loss",)), (right, ("recall", "all_three", "iou", "empty_right"))):
        for name in names:
            points = [(row["step"], row[name]) for row in rows if row.get(name) is not None]
            if points:
                axes.plot(*zip(*points, strict=True), label=name, marker="." if axes is right else None)
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend()
    left.set_yscale("log")
    return figure
