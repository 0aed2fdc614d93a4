"""Refuse several devices, and runs of other steps than asked."""

import pytest
from test_training import FEW, MODEL, near_planes
from torch.utils.data import DataLoader

from csph.networks.config import preset
from csph.training.data import SetData
from csph.training.hardware import Hardware, trainer_on
from csph.training.loop import train
from csph.training.views import split_views
from scenes import InputError


@pytest.mark.parametrize("devices", [2, 0, "2"])
def test_several_devices_are_refused(devices):
    """They took a share of the steps each, on a larger batch, and said nothing."""
    with pytest.raises(InputError, match=rf"training: {devices} devices: a training is on one device"):
        trainer_on(Hardware(accelerator="cpu", devices=devices), preset("smoke", MODEL, **FEW), [])


def test_a_run_of_other_steps_than_asked_is_no_success(tmp_path, monkeypatch):
    """Several devices took fewer steps; here a loader of half the batches does."""
    whole = SetData.train_dataloader

    def half(self: SetData) -> DataLoader:
        return DataLoader([*whole(self)][: self.config.steps_per_epoch // 2], batch_size=None)

    monkeypatch.setattr(SetData, "train_dataloader", half)
    with pytest.raises(InputError, match="the run took 3 steps of 9"):
        train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path / "run")
    assert not (tmp_path / "run/last.safetensors").exists()
