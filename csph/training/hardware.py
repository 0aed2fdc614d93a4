"""Say what a training runs on, and run Lightning's loop there."""

from __future__ import annotations

import logging
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytorch_lightning as pl
from lightning_fabric.plugins.environments import LightningEnvironment

from csph.networks.config import TrainConfig
from csph.training.resume import WholeFileCheckpoints
from scenes.errors import require

ONE_DEVICE = "a training is on one device: on several, Lightning would take fewer steps of larger batches"


@dataclass(frozen=True)
class Hardware:
    """Name what a training runs on: processes that draw samples, and Lightning's accelerator, device and strategy.

    Raises InputError for several devices. Lightning deals the batches of an epoch out to them, so that N devices take
    1 / N of the steps, on N times the batch, and are at 1 / N of the learning rate's course when the run ends.
    """

    workers: int = 0
    accelerator: str = "auto"
    devices: int | str = 1
    strategy: str = "auto"

    def __post_init__(self) -> None:
        several = isinstance(self.devices, int) and self.devices != 1
        require(not several, f"training: {self.devices} devices: {ONE_DEVICE}")


ANY_HARDWARE = Hardware()


class _SignalsOfTheCaller(pl.Callback):
    """Leave SIGTERM to who began the training: Lightning ends a run by it where it is ignored, too, and where it has no
    handler makes a Ctrl-C of it, at the next step."""

    before: signal.Handlers | int | Callable[..., object] | None = None

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self.before = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self.before)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning's advice on workers and devices, which is not the user's business: what is said here goes to
    the log."""
    loggers = [logging.getLogger(name) for name in ("pytorch_lightning", "lightning_fabric", "lightning.pytorch")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def trainer_on(hardware: Hardware, config: TrainConfig, callbacks: Sequence[pl.Callback]) -> pl.Trainer:
    """Return Lightning's Trainer without what the callbacks do instead. InputError for several devices, and mixed
    precision on a CPU."""
    with _quiet():
        runner = pl.Trainer(
            max_epochs=config.epochs,
            precision=config.precision,
            callbacks=[_SignalsOfTheCaller(), *callbacks],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            # a job of several tasks (Slurm) is not one training on all of them, nor is it put back into the queue here
            plugins=[WholeFileCheckpoints(), LightningEnvironment()],
            reload_dataloaders_every_n_epochs=1,
            accelerator=hardware.accelerator,
            devices=hardware.devices,
            strategy=hardware.strategy,
        )
    # names such as "auto" and "0,1" are Lightning's
    require(runner.world_size == 1, f"training: {runner.world_size} devices: {ONE_DEVICE}")
    # there, weights' gradients in bf16 read memory that was never written (torch 2.13)
    on_cpu = runner.strategy.root_device.type == "cpu"
    require(config.precision == "32-true" or not on_cpu, f"precision {config.precision} needs a GPU")
    return runner


def fit(runner: pl.Trainer, module: pl.LightningModule, data: pl.LightningDataModule, resume: Path) -> None:
    """Run Lightning's loop to its end, from the state in `resume` on where there is one. InputError for a run that
    took another number of steps than its configuration says."""
    on_interrupt = signal.getsignal(signal.SIGINT)
    with _quiet():
        try:
            runner.fit(module, data, ckpt_path=resume if resume.is_file() else None, weights_only=True)
        except SystemExit:  # what Lightning makes of Ctrl-C, which it leaves ignored where that came before its loop
            if on_interrupt is not None and threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, on_interrupt)
            raise KeyboardInterrupt from None
    taken, asked = runner.global_step, module.config.steps
    require(taken == asked, f"{resume.parent}: the run took {taken} steps of {asked}; delete it to begin the run again")
