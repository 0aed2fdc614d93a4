"""The state of an interrupted run: written whole wherever TMPDIR lies, and never believed when it is damaged."""

from pathlib import Path

import pytest
import torch
from torch import nn

from csph.training.resume import KEYS, WholeFileCheckpoints, check_resume
from scenes import InputError

MODULE = nn.Linear(3, 2)


def state(**changes) -> dict:
    whole = {key: {} for key in KEYS} | {"state_dict": MODULE.state_dict()}
    return {key: value for key, value in (whole | changes).items() if value is not None}


def test_a_state_is_written_beside_its_place_and_renamed(tmp_path, monkeypatch):
    """Nothing passes through TMPDIR, and the old state is there until the new one is whole."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "not there"))
    path, seen = tmp_path / "resume.ckpt", []
    path.write_bytes(b"old")
    replace = Path.replace

    def renamed(self: Path, target: Path) -> Path:
        seen.append((self.parent, target.read_bytes()))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", renamed)
    WholeFileCheckpoints().save_checkpoint(state(), path)
    assert seen == [(tmp_path, b"old")] and [p.name for p in tmp_path.iterdir()] == ["resume.ckpt"]
    check_resume(path, MODULE)


def test_every_damage_is_one_line_with_its_cure(tmp_path):
    path = tmp_path / "resume.ckpt"
    torch.save(state(), path)
    data = path.read_bytes()
    weights = data.index(MODULE.weight.detach().numpy().tobytes())
    flipped = data[:weights] + bytes([data[weights] ^ 1]) + data[weights + 1 :]
    for content in (b"", data[:100], data[:-1], flipped, b"text" * 100):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"^[^\n]*resume\.ckpt: [^\n]*delete it to begin the run again$"):
            check_resume(path, MODULE)


def test_foreign_states_and_code_in_a_pickle_are_refused(tmp_path):
    path = tmp_path / "resume.ckpt"
    for content, why in (
        (state(loops=None), "loops are missing"),
        ({"a": 1}, "no state of an interrupted run"),
        (state(state_dict=nn.Linear(4, 2).state_dict()), "another model's weights"),
        (state(callbacks={"run": print}), "no checkpoint of tensors alone"),
    ):
        torch.save(content, path)
        with pytest.raises(InputError, match=why):
            check_resume(path, MODULE)
