"""Record how the energy of a learned temporal code moves over time bins in training: `energy.csv` of a run."""

from __future__ import annotations

from pathlib import Path

import pytorch_lightning as pl

from csph.codes.temporal import grouped_energy
from scenes.files import write_csv

SNAPSHOTS = 48  # over a run, besides its start


class CodeEnergy(pl.Callback):
    """Keeps `grouped_energy` at the start and about SNAPSHOTS times of a run; nothing where no temporal code is
    learned.

    Its rows travel in Lightning's checkpoint, so that a run that goes on writes the file that an unbroken one does.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[dict[str, float]] = []

    def state_dict(self) -> dict[str, list[dict[str, float]]]:
        return {"rows": self.rows}

    def load_state_dict(self, state: dict[str, list[dict[str, float]]]) -> None:
        self.rows = state["rows"]

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not self.rows:
            self._keep(module, 0)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: object) -> None:
        step, last = trainer.global_step, module.config.steps
        if step != last and step % max(1, last // SNAPSHOTS) == 0:
            self._keep(module, step)

    def on_train_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.global_step == module.config.steps:  # of the code that is kept: by now it holds `init_share`
            self._keep(module, trainer.global_step)
        if self.rows and trainer.is_global_zero:
            write_csv(self.rows, self.folder / "energy.csv")

    def _keep(self, module: pl.LightningModule, step: int) -> None:
        layer = module.model.layer
        if layer is not None and layer.temporal.requires_grad:
            energy = grouped_energy(module.kept.layer.temporal)
            self.rows = [*self.rows, {"step": step, **{f"group_{i}": float(e) for i, e in enumerate(energy)}}]
