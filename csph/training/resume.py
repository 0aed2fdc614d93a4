"""Write the state of a run as a whole file, and check it before an interrupted run goes on from it."""

from __future__ import annotations

import io
from pathlib import Path

import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import nn

from csph.weights.torch_files import load_torch_file
from scenes.errors import InputError
from scenes.files import whole_file

KEYS = ("state_dict", "optimizer_states", "lr_schedulers", "callbacks", "loops", "epoch", "global_step")
CURE = "delete it to begin the run again"


class WholeFileCheckpoints(TorchCheckpointIO):
    """Write checkpoints beside their place, flush them, and rename them.

    Lightning's own writer goes through TMPDIR: where that is another file system, its rename is a copy, and a kill in
    the middle of it leaves an empty file in place of the old state.
    """

    def save_checkpoint(self, checkpoint: dict[str, object], path: str | Path, storage_options: object = None) -> None:
        # by way of memory: torch would name the archive after the temporary file, and has no OSError for a full disk
        state = io.BytesIO()
        torch.save(checkpoint, state)
        with whole_file(Path(path)) as beside:
            beside.write_bytes(state.getbuffer())


def check_resume(path: Path, module: nn.Module) -> None:
    """Raise InputError in one line unless `path` is an undamaged state of this module.

    Every byte is compared with the archive's checksums, nothing but tensors and plain values is unpickled, and names
    and shapes of the weights are the module's.
    """
    try:
        state = load_torch_file(path)
    except InputError as error:
        raise InputError(f"{error}; {CURE}") from None
    missing = [key for key in KEYS if not isinstance(state, dict) or key not in state]
    if not isinstance(state, dict) or missing:
        raise InputError(f"{path}: is no state of an interrupted run, {', '.join(missing)} are missing; {CURE}")
    if not isinstance(state["state_dict"], dict):
        raise InputError(f"{path}: is no state of an interrupted run, its state_dict is none; {CURE}")
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    found = {name: tuple(getattr(value, "shape", ())) for name, value in state["state_dict"].items()}
    if expected != found:
        other = sorted(str(name) for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        raise InputError(f"{path}: holds another model's weights ({', '.join(other[:3])}); {CURE}")
