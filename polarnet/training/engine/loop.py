"""The training loop that every trained network shares (`train`)."""

import math
from collections import Counter
from collections.abc import Iterator
from statistics import fmean
from typing import Annotated

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from polarnet.events.representations import REPRESENTATIONS
from polarnet.metrics.similarity import correlation, mse, psnr
from polarnet.runtime.files import check_room
from polarnet.runtime.machine import precision_on
from polarnet.runtime.sections import one_of, section
from polarnet.terminal.progress import ProgressBar
from polarnet.training.engine.calibration import Scene, fitted, joined, weights_for
from polarnet.training.engine.losses import known_frames
from polarnet.training.engine.optimizers import OPTIMIZERS, Optimizer
from polarnet.training.engine.recorder import Recorder
from polarnet.training.engine.sequences import ViewConfig, Visits, WindowDataset, Windows, batches_of, loaded_if_it_fits
from polarnet.training.engine.task import Split, State, Task

SCORES = {"mse": mse, "psnr": psnr, "correlation": correlation}
COPIES_OF_WEIGHTS = 12  # on disk: best, last, and twice (old and new) the running checkpoint with best and two moments
MAX_SCENES = 300  # sequences in the expected-error fit, spread evenly; more cost time and change it little
MAX_BLOCKS = 10_000  # 2x2-pixel blocks per sequence in the expected-error fit; errors of neighbouring blocks are alike

Run = tuple[Tensor, Tensor, Tensor | None]
"""Consecutive windows of a batch, their truth, and the mask of known truth (None: all known)."""


@section
class LoopConfig(ViewConfig):
    """Training settings shared by the sections `train`, `baselines.e2v` and `baselines.e2p` of params.yaml."""

    epochs: Annotated[int, Field(gt=0, le=100_000)]
    batch_size: Annotated[int, Field(gt=0, le=10_000)]
    """Number of visits to sequences in one batch."""
    bptt_windows: PositiveInt
    """Windows per optimizer step. The recurrent state passes from step to step, gradients do not."""
    learning_rate: Annotated[float, Field(gt=0, le=1)]
    """Peak learning rate."""
    schedule: Annotated[str, one_of(("constant", "cosine"))]
    """cosine: decay from the peak rate to 0 over the training."""
    warmup: Annotated[float, Field(ge=0, le=1)]
    """Fraction of the training over which the rate rises from 0."""
    gradient_norm: PositiveFloat | None
    """Largest norm of all gradients together; longer gradients are scaled down to it. null: no limit."""
    precision: Annotated[str, one_of(("auto", "fp32", "bf16"))]
    """Precision of autocast; weights and optimizer state are always float32. auto: bf16 if the device has units for
    it."""


@section
class TrainConfig(LoopConfig):
    """Section `train` of params.yaml."""

    representation: Annotated[str, one_of(REPRESENTATIONS)] | None
    """Representation of the events in a window; null: the network's own default."""
    optimizer: Annotated[str, one_of(OPTIMIZERS)] | None
    """Name of the optimizer; null: the network's own default."""
    start: str | None
    """Checkpoint (.safetensors) of the same network whose weights the training starts from; null: random weights."""
    scene_dolp: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)] | None
    """[median, 90th percentile] of the mean DoLP of real scenes: expected errors are fitted half to the training
    pictures and half to scenes like these, variants included; null: to the training pictures alone."""

    def __post_init__(self):
        super().__post_init__()
        if self.scene_dolp is not None and not self.scene_dolp[0] < self.scene_dolp[1] < 1:
            raise ValueError(f"scene_dolp: expected median < 90th percentile < 1, got {self.scene_dolp}")


def train(
    task: Task, split: Split, config: LoopConfig, recorder: Recorder, seed: int, device: torch.device, workers: int
) -> None:
    """Train the task's network, or resume a killed run of the same training that the recorder holds.

    All random numbers derive from the seed, the epoch and the sequence's name, so neither an interruption nor the
    number of workers (processes that read ahead) changes the weights. OSError if the disk has no room for the
    checkpoints.
    """
    weights = sum(tensor.nbytes for tensor in task.network.state_dict().values())
    check_room(recorder.running, COPIES_OF_WEIGHTS * weights, "the checkpoints")
    network = task.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = OPTIMIZERS[task.optimizer](network, config.learning_rate)
    recorder.resume(network, optimizer)
    helpers = workers if device.type == "cuda" else 0  # on a processor, the training itself needs the cores
    epochs = range(len(recorder.history), config.epochs)
    loaded = loaded_if_it_fits(split.train, task.wants_intensity, helpers) if epochs else None
    sequences, workers = (split.train, workers) if loaded is None else (loaded, helpers)
    for epoch in epochs:
        visits = Visits(sequences, config, seed, epoch)
        means = train_epoch(task, optimizer, visits, config, device, workers)
        scores = validate(task, split.val, config, device, workers)
        recorder.end_epoch(network, optimizer, means, scores)
    if hasattr(network, "expected"):
        network.load_state_dict(recorder.best)
        recorder.calibrated(network, calibrate(task, sequences_to_fit(task, split.train), config, device, workers))
    recorder.finish()


def train_epoch(
    task: Task, optimizer: Optimizer, visits: Visits, config: LoopConfig, device: torch.device, workers: int
) -> dict[str, float]:
    """Return means of the loss and its terms over the steps; FloatingPointError if a loss is infinite or NaN."""
    sums, steps, done = Counter[str](), 0, 0
    order, title = visits.order(), f"epoch {visits.epoch + 1}/{config.epochs}"
    with ProgressBar(total=len(order), desc=title, unit="visit") as bar:
        for batch in batches_of(visits, order, config.batch_size, workers):
            set_learning_rate(optimizer, config, (visits.epoch + done / len(order)) / config.epochs)
            for terms in train_batch(task, optimizer, batch, config, device):
                if not math.isfinite(terms["total"]):
                    raise FloatingPointError(
                        f"the loss is {terms['total']} in epoch {visits.epoch + 1} after {steps} steps; lower "
                        "learning_rate, set gradient_norm, or use precision=fp32"
                    )
                sums.update(terms)
                steps += 1
            done += len(batch.names)
            bar.set_postfix(loss=f"{sums['total'] / steps:.4f}", refresh=False)
            bar.update(len(batch.names))
    return {name: value / steps for name, value in sums.items()}


def train_batch(
    task: Task, optimizer: Optimizer, batch: Windows, config: LoopConfig, device: torch.device
) -> list[dict[str, float]]:
    """Take one optimizer step per run of `bptt_windows` windows; return the loss and its terms at each step."""
    state: State = None
    losses = []
    for windows, frames, valid in runs_of(task, batch, config.bptt_windows, device):
        task.network.zero_grad()
        with autocast(config.precision, device):
            predicted, state = task.unroll(windows, state)
            terms = task.loss(predicted, frames, valid)
            total = task.loss.total(terms)
        total.backward()
        state = [tensor.detach() for tensor in state or []]
        if config.gradient_norm is not None:
            nn.utils.clip_grad_norm_(task.network.parameters(), config.gradient_norm)
        optimizer.step()
        values = torch.stack([total, *terms.values()]).tolist()
        losses.append(dict(zip(("total", *terms), values, strict=True)))
    return losses


def runs_of(task: Task, batch: Windows, length: int, device: torch.device) -> Iterator[Run]:
    """Yield runs of `length` windows of a batch, on the device."""
    read = batch if task.wants_intensity else batch._replace(intensity=batch.intensity[:0])
    there = Windows(read.names, *(None if field is None else field.to(device) for field in read[1:]))  # type: ignore
    inputs, truth, valid = task.streams(there._replace(inputs=there.inputs.float()))
    windows, frames = inputs.split(length), truth.split(length)
    masks = [None] * len(frames) if valid is None else valid.split(length)
    return zip(windows, frames, masks, strict=True)


@torch.no_grad()
def validate(
    task: Task, dataset: WindowDataset, config: LoopConfig, device: torch.device, workers: int
) -> dict[str, float]:
    """Return means over all frames of the loss, its terms, and the MSE, PSNR and correlation of the unclamped frames.

    Only valid pixels count, and frames without any are skipped. ValueError if no frame has a valid pixel.
    """
    task.network.eval()
    sums, count = Counter[str](dict.fromkeys(("total", *task.loss.weights, *SCORES), 0.0)), 0
    batches = batches_of(dataset, range(len(dataset)), 1, workers)
    for batch in ProgressBar(batches, "validation", len(dataset), unit="sequence"):
        state = None
        for windows, frames, valid in runs_of(task, batch, config.bptt_windows, device):
            with autocast(config.precision, device):
                predicted, state = task.unroll(windows, state)
                terms = task.loss(predicted, frames, valid)
            a, b, known = known_frames(task.scored(predicted), task.scored(frames), valid)
            scores = {"total": task.loss.total(terms), **terms}
            if len(a):
                scores |= {name: score(a, b, known).mean() for name, score in SCORES.items()}
                sums.update({name: value.item() * len(a) for name, value in scores.items()})
                count += len(a)
    task.network.train()
    if not count:
        raise ValueError(f"{dataset.frames.path}: no validation frame has a valid pixel; use other pictures")
    return {name: value / count for name, value in sums.items()}


def set_learning_rate(optimizer: Optimizer, config: LoopConfig, done: float) -> None:
    """Set the learning rate for the fraction `done` of the training: peak rate times warm-up times schedule."""
    rise = min(1.0, done / config.warmup) if config.warmup else 1.0
    fall = (1 + math.cos(math.pi * done)) / 2 if config.schedule == "cosine" else 1.0
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * rise * fall


def autocast(precision: str, device: torch.device) -> torch.autocast:
    """Run convolutions and matrix products in bfloat16 if `precision` resolves to bf16 on this device."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision_on(device, precision) == "bf16")


def sequences_to_fit(task: Task, dataset: WindowDataset) -> WindowDataset:
    """At most MAX_SCENES sequences; those of variants only if the task says for which scenes to fit."""
    varied = dataset.frames.variant_of
    names = sorted(dataset.sequences, key=lambda name: name in varied)
    if task.scene_dolp is None:
        names = [name for name in names if name not in varied]
    return WindowDataset(dataset.events, dataset.frames, names[:: math.ceil(len(names) / MAX_SCENES)], dataset.encode)


@torch.no_grad()
def calibrate(
    task: Task, dataset: WindowDataset, config: LoopConfig, device: torch.device, workers: int
) -> dict[str, int | float]:
    """Fit the network's expected errors to its errors on `dataset` (polarnet.training.engine.calibration).

    The fit also includes one frame of each sequence predicted without any events. If the task names the DoLP of real
    scenes, half of its weight is on the pictures, and half on all sequences, with `weights_for` such scenes. Returns a
    record of the fit for the checkpoint.
    """
    task.network.eval()
    scenes: dict[str, Scene] = {}
    mean_squared, mean_dolp = [], []
    batches = batches_of(dataset, range(len(dataset)), 1, workers)
    for batch in ProgressBar(batches, "expected errors", len(dataset), unit="sequence"):
        scene, mse = sampled_sequence(task, batch, config, device)
        if len(scene.squared):
            scenes[batch.names[0]] = scene
            mean_squared.append(mse)
            mean_dolp.append((batch.dolp if batch.valid is None else batch.dolp[batch.valid]).mean().item())
    if task.scene_dolp is not None:
        pictures = {name: float(name not in dataset.frames.variant_of) for name in scenes}
        share = fmean(pictures.values())
        for (name, scene), weight in zip(scenes.items(), weights_for(mean_dolp, *task.scene_dolp), strict=True):
            scenes[name] = scene._replace(weights=scene.weights * (pictures[name] + share * weight))
    of_pictures: dict[str, list[Scene]] = {}
    for name, scene in scenes.items():
        of_pictures.setdefault(dataset.frames.original_of(name), []).append(scene)
    fit = fitted([joined(of_picture) for of_picture in of_pictures.values()])
    task.network.get_submodule("expected").load_state_dict({"weight": fit.weight, "bias": torch.tensor(fit.bias)})
    task.network.train()
    return {"sequences": len(scenes), "mse": fmean(mean_squared), "ridge": fit.ridge}


def sampled_sequence(task: Task, batch: Windows, config: LoopConfig, device: torch.device) -> tuple[Scene, float]:
    """Sampled errors of a batch's only sequence and of one frame without events, and the MSE without that frame."""
    every = max(1, round(math.sqrt(batch.dolp.numel() / 4 / MAX_BLOCKS)))  # along each axis
    samples: list[Scene] = []
    state: State = None
    runs = list(runs_of(task, batch, config.bptt_windows, device))
    for run in runs:
        sample, state = sampled_errors(task, run, state, every, config.precision)
        samples.append(sample)
    windows, frames, valid = runs[0]
    still = torch.zeros_like(windows[:1]), frames[:1], None if valid is None else valid[:1]
    without_events, _ = sampled_errors(task, still, None, every, config.precision)
    return joined([*samples, without_events]), joined(samples).squared.mean().item()


def sampled_errors(task: Task, run: Run, state: State, every: int, precision: str) -> tuple[Scene, State]:
    """Features and squared errors of one 2x2-pixel block in `every` along each axis, and the state after the run."""
    windows, frames, valid = run
    with autocast(precision, windows.device):
        predicted, features, state = task.network.unroll_with_features(windows, state)  # type: ignore[operator]
    errors = (predicted.dolp.clamp(0, 1) - task.scored(frames)).square()
    known = torch.ones_like(errors) if valid is None else valid.to(errors)
    squared, share_known = (avg_pool2d(image.flatten(0, 1), 2)[:, ::every, ::every] for image in (errors, known))
    height, width = (every * size for size in squared.shape[-2:])
    features = features[..., :height:every, :width:every].permute(0, 2, 3, 1)[share_known == 1]
    squared = squared[share_known == 1].double().cpu()
    return Scene(features.double().cpu(), squared, torch.ones_like(squared)), state
