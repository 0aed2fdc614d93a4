"""Fixed codes of a user's file in training: read once, and kept in the run's folder for when the file is gone."""

from __future__ import annotations

from pathlib import Path

from csph.codes.design import OWN
from csph.codes.files import own_codes
from csph.codes.tensor import CodingTensor
from csph.networks.config import TrainConfig
from scenes.errors import require
from scenes.files import whole_file
from scenes.io.inputs import read_bytes

KEPT = "codes"  # of a run: a copy of the file, with its ending
FILE = "codes_file"  # in a configuration's data: where the file lies


def _kept(file: Path, folder: Path) -> Path:
    return folder / f"{KEPT}{file.suffix.lower()}"


def codes_path(file: Path, folder: Path) -> Path:
    """Return a file of own codes, or its copy in a run's folder where it is gone."""
    kept = _kept(file, folder)
    return kept if kept.is_file() and not file.exists() else file


def own_codes_of(config: TrainConfig, folder: Path) -> CodingTensor | None:
    """Return the codes of a run with own codes, from `data["codes_file"]` or the copy in its folder; None of others.

    Raises InputError where neither is there, and for a file that is no longer the one of the configuration.
    """
    design = config.model.design
    if design is None or design.code != OWN:
        return None
    require(FILE in config.data, f"training: {design.name}: expected data[{FILE!r}], the path of its codes")
    path = codes_path(Path(str(config.data[FILE])), folder)
    found, coding = own_codes(path)
    changed = f"{path}: its SHA-256 is {found.sha256}, that of the configuration {design.sha256}"
    require(found.sha256 == design.sha256, changed)
    return coding


def keep_codes(config: TrainConfig, folder: Path) -> None:
    """Copy a run's file of own codes into its folder, unless it is there."""
    if FILE not in config.data:
        return
    file = Path(str(config.data[FILE]))
    kept = _kept(file, folder)
    if not kept.is_file():
        contents = read_bytes(file)
        with whole_file(kept) as beside:
            beside.write_bytes(contents)
