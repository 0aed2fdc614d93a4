"""`bench network`: both depth networks by seconds, training steps a second, and error after equal time in training; and
the published network as it runs here beside the published layers written down plainly."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from csph.codes.design import Design
from csph.evaluation.methods import EvaluationPlan, evaluate
from csph.networks.config import NETWORKS, ModelConfig, Network, preset
from csph.networks.model import DepthModel
from csph.networks.published import DeepBoosting, parameters_of
from csph.training.loss import kl_divergence
from csph.training.views import split_views
from render.backend.malloc import retain_freed_memory
from scene2spad.datasets.planes import random_planes
from scene2spad.options.experiments import Bench
from scenes.errors import require
from scenes.files import write_csv
from scenes.progress import Progress
from spad.detection.training_patches import pack_views, sense_patches

PATCH = (1, 1, 1024, 32, 32)  # what multiply-accumulates are counted for
FRAME = (1, 1, 1024, 72, 88)  # a published test frame
PRESET = "laptop"  # whose batch, crop and learning rate a step has
DESIGN = Design("learned", (256, 4, 4), 32)
MEASURED: tuple[Network, ...] = ("compact", "published")
SCENES, VIEW_PIXELS, TEST_SCENES = 200, 64, 4
LEVELS = ((10.0, 10.0), (10.0, 200.0))
SECONDS, QUICK_SECONDS = 180.0, 20.0  # of training


@dataclass(frozen=True)
class Row:
    """One network; error is its mean absolute depth error [mm] on planes after `trained_s` of training (both networks
    alike), of the plain layers their largest deviation from ours, relative to the largest logit."""

    name: str
    parameters: int
    gmac: float
    seconds: float  # per 72 x 88 frame
    step_s: float  # forward and backward of a training step at the preset's batch and crop, down to the codes
    step_cpu_s: float  # the same in CPU seconds of all threads, which others on the machine hardly change
    steps_per_s: float  # of training, sensing and the optimiser included
    trained_s: float
    trained_steps: int
    error: float


class PlainDeepBoosting(DeepBoosting):
    """The published layers one by one, each transposed convolution by torch's own: what ours is judged against."""

    def expand(self, x: Tensor) -> Tensor:
        for step in self.up[:-1]:
            x = step(x).relu()
        logits = self.out(self.up[-1](x)).squeeze(1)
        return logits.relu() if self.final_relu else logits


def gmac(network: nn.Module, size: tuple[int, ...] = PATCH) -> float:
    """Count multiply-accumulates of one forward pass, in 10^9; torch counts two operations for each."""
    shapes = deepcopy(network).to("meta")  # counting needs no numbers
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        shapes(torch.zeros(size, device="meta"))
    return counter.get_total_flops() / 2e9


def seconds_of(work: Callable[[], object], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return median of warm runs."""
    work()
    taken = []
    for _ in range(repeats):
        start = clock()
        work()
        taken.append(clock() - start)
    return statistics.median(taken)


def _step(network: nn.Module, x: Tensor) -> Callable[[], None]:
    def step() -> None:
        network.zero_grad(set_to_none=True)
        network(x.detach().requires_grad_()).logsumexp(1).mean().backward()  # learned codes need the input's

    return step


def run(command: Bench, progress: Progress) -> dict:
    """Measure, write the table (.csv), and return its rows."""
    require(not command.out.is_file(), f"{command.out}: is a file, expected a folder for the results")
    retain_freed_memory()  # as training does
    limit = QUICK_SECONDS if command.quick else SECONDS
    rows = []
    for number, name in enumerate(MEASURED):
        progress(f"{name} network", number / 3)
        rows.append(measure(name, limit, command.repeats, command.seed))
    progress("plain layers", 2 / 3)
    rows.append(measure_plain(command.repeats, command.seed))
    command.out.mkdir(parents=True, exist_ok=True)
    table = write_csv([asdict(row) for row in rows], command.out / "network.csv")
    machine = (
        f"{os.cpu_count()} cores ({torch.get_num_threads()} threads), {platform.machine()}, torch {torch.__version__}"
    )
    ratio = rows[2].step_s / rows[1].step_s
    result = {"machine": machine, "plain_step_over_ours": ratio, "csv": str(table)}
    return {"rows": [asdict(row) for row in rows], **result} if command.json else {"rows": _lines(rows), **result}


def measure(name: Network, limit_s: float, repeats: int, seed: int) -> Row:
    """Return one network behind learned 256x4x4 codes at 128x: its costs, and its error after `limit_s` of training."""
    require(name in NETWORKS, f"network {name!r} is unknown")
    config = preset(PRESET, ModelConfig(design=DESIGN, network=name), seed=seed)
    model = DepthModel(config.model, seed)
    patches = torch.rand(config.batch, 1, 1024, config.crop, config.crop)
    frame = torch.rand(FRAME)
    with torch.no_grad():
        frame_s = seconds_of(lambda: model.network(frame), repeats)
    step_s, step_cpu_s = _step_seconds(model.network, patches, repeats)
    steps, taken, error = train_for(model, limit_s, seed)
    size, work = parameters_of(model.network), gmac(model.network)
    return Row(name, size, work, frame_s, step_s, step_cpu_s, steps / taken, taken, steps, error)


def _step_seconds(network: nn.Module, x: Tensor, repeats: int) -> tuple[float, float]:
    step = _step(network, x)
    return seconds_of(step, repeats), seconds_of(step, repeats, time.process_time)


def train_for(model: DepthModel, limit_s: float, seed: int) -> tuple[int, float, float]:
    """Return steps, seconds and final error [mm] of training on random planes until the time is up, at least one
    step."""
    training, rest = split_views(random_planes(SCENES, size=VIEW_PIXELS, seed=seed))
    packed, sensor = pack_views(training.transients), model.config.sensor
    config = preset(PRESET, model.config, seed=seed)
    adam = torch.optim.Adam(model.parameters(), lr=config.rate, fused=True)
    from csph.training.data import Samples  # and Lightning, which takes seconds to import

    samples, step, start = Samples([packed], replace(config, steps_per_epoch=1 << 20), 0), 0, time.perf_counter()
    while step == 0 or time.perf_counter() - start < limit_s:
        requests = [samples[step * config.batch + i].patch for i in range(config.batch)]
        batch = sense_patches(packed, sensor, requests, size=(config.crop, config.crop))
        adam.zero_grad()
        kl_divergence(model(batch.counts), batch.depth_m, batch.valid, sensor).backward()
        adam.step()
        step += 1
    taken = time.perf_counter() - start
    views = rest._replace(transients=rest.transients[:TEST_SCENES], scenes=rest.scenes[:TEST_SCENES])
    found = evaluate({"network": lambda h: model.depth_of(h)[0]}, views, sensor, EvaluationPlan(LEVELS, seed=seed))
    interval = found.interval(["network"])
    return step, taken, float("nan") if interval is None else interval.mean


def measure_plain(repeats: int, seed: int) -> Row:
    """Return the published layers as they stand, with the same weights as ours."""
    torch.manual_seed(seed)
    ours, plain = DeepBoosting(final_relu=False), PlainDeepBoosting(final_relu=False)
    plain.load_state_dict(ours.state_dict())
    config = preset(PRESET, ModelConfig(design=DESIGN, network="published"))
    patches, frame = torch.rand(config.batch, 1, 1024, config.crop, config.crop), torch.rand(FRAME)
    with torch.no_grad():
        reference, logits = plain(patches[:1]), ours(patches[:1])
        frame_s = seconds_of(lambda: plain(frame), repeats)
    error = float((reference - logits).abs().max() / reference.abs().max())
    step_s, step_cpu_s = _step_seconds(plain, patches, repeats)
    size, work = parameters_of(plain), gmac(plain)
    return Row("published, plain layers", size, work, frame_s, step_s, step_cpu_s, 1 / step_s, 0.0, 0, error)


def _lines(rows: list[Row]) -> list[str]:
    lines = [f"{'network':<24} {'GMAC':>6} {'s / frame':>10} {'s / step':>9} {'CPU s':>6} {'steps':>6} {'error':>9}"]
    for row in rows:
        lines.append(
            f"{row.name:<24} {row.gmac:>6.2f} {row.seconds:>10.3f} {row.step_s:>9.3f} {row.step_cpu_s:>6.2f} "
            f"{row.trained_steps:>6} {row.error:>9.3g}"
        )
    return lines
