"""Coding tensors in files, as .npy arrays and as text tables: in decimal, or rounded to 8-bit integers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from csph.codes.design import OWN, Design
from csph.codes.quantise import quantised
from csph.codes.tensor import CodingTensor
from scenes.errors import InputError, require
from scenes.files import read_array, whole_file
from scenes.io.inputs import file_sha256, read_text

# The line above a factor's rows
FACTOR = re.compile(r"# (temporal|spatial), shape (\d+(?: x \d+)*)(?:, int8, one step is (\S+))?")


class _Part(NamedTuple):
    """A factor as a text table states it, and its rows."""

    shape: str
    step: str | None
    rows: list[list[str]]


def read_codes(path: Path) -> CodingTensor:
    """Read a coding tensor from a .npy file, (K, Mt) or (K, Mt, Mr, Mc), or from a text table of `write_codes`; the
    file's name is its name.

    Raises InputError in one line that names the file.
    """
    path = Path(path)
    parts = _text_parts(path) if path.suffix.lower() == ".txt" else {"temporal": _array_part(path)}
    try:
        return CodingTensor(path.stem, parts["temporal"], parts.get("spatial"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _array_part(path: Path) -> Tensor:
    values = read_array(path)
    if values.ndim not in (2, 4):
        raise InputError(f"{path}: shape {values.shape}, expected codes (K, T) or (K, Mt, Mr, Mc)")
    return torch.from_numpy(values.astype(np.float64))


def _text_parts(path: Path) -> dict[str, Tensor]:
    """Read the factors of a text table by their names; other comments and blank lines are passed over. Raises
    InputError that names the file."""
    stated = _stated_parts(path)
    require("temporal" in stated, f"{path}: is no table of codes as `export` writes it")
    parts = {}
    for name, part in stated.items():
        try:
            shape = [int(size) for size in part.shape.split(" x ")]
            if len(part.rows) != shape[0]:
                raise ValueError
            values = np.array(part.rows, np.float64) * float(part.step or 1)
            parts[name] = torch.from_numpy(values.reshape(shape))
        except ValueError:
            raise InputError(f"{path}: {name} part holds other than the {part.shape} numbers that it states") from None
    return parts


def _stated_parts(path: Path) -> dict[str, _Part]:
    parts: dict[str, _Part] = {}
    rows: list[list[str]] | None = None
    text = read_text(path, "table of codes")
    cut = f"{path}: ends within a line, so that its last number may be cut short; end the last line, or write it again"
    require(not text or text.endswith(("\n", "\r")), cut)
    for line in text.splitlines():
        found = FACTOR.fullmatch(line.strip())
        if found:
            require(found[1] not in parts, f"{path}: states its {found[1]} part twice")
            rows = []
            parts[found[1]] = _Part(found[2], found[3], rows)
        elif line.strip() and not line.lstrip().startswith("#"):
            if rows is None:
                raise InputError(f"{path}: is no table of codes as `export` writes it")
            rows.append(line.split())
    return parts


def own_codes(path: Path) -> tuple[Design, CodingTensor]:
    """Return the fixed codes of a file (.npy, .txt) as a design and its tensor: `DepthModel` takes both.

    Raises InputError in one line that names the file.
    """
    coding = read_codes(path)
    require(bool(coding.tensor.any()), f"{path}: all codes are zero")
    several = coding.block[1:] != (1, 1)
    sha256 = file_sha256(path)
    design = Design(OWN, coding.block, coding.codes, full=several, spatial_learned=False, sha256=sha256)
    # (K, Mt, 1, 1) are codes (K, Mt) of single pixels
    return design, CodingTensor(design.name, coding.tensor if several else coding.tensor.flatten(1))


def write_codes(coding: CodingTensor, path: Path, *, int8: bool = False) -> Path:
    """Write a coding tensor as .npy, (K, Mt) or (K, Mt, Mr, Mc) float32 or int8, or as text with a row a code.

    Text names each factor of a separable tensor, and with `int8` the value of one step; an int8 array's step is in
    `step_file` beside it. Raises InputError for another ending.
    """
    if path.suffix.lower() == ".npy":
        exact = quantised(coding) if int8 else None
        whole = coding.tensor.numpy() if exact is None else exact.tensor
        flat = whole[..., 0, 0] if coding.block[1:] == (1, 1) else whole
        # to an open file: numpy would add .npy to a name that ends in .NPY
        with whole_file(path) as beside, beside.open("wb") as file:
            np.save(file, np.ascontiguousarray(flat))
        if exact is not None:
            with whole_file(step_file(path)) as beside:
                beside.write_text(f"{_heading(coding)}\n# int8, one step is\n{exact.scale:.9g}\n")
        return path
    if path.suffix.lower() != ".txt":
        raise InputError(f"{path}: codes go to .npy or .txt")
    with whole_file(path) as beside:
        beside.write_text(codes_text(coding, int8=int8))
    return path


def step_file(path: Path) -> Path:
    """Return the name of the text beside an array of int8 codes: the value of one step, which times them is codes."""
    return path.with_name(f"{path.stem}.step.txt")


def _heading(coding: CodingTensor) -> str:
    bins, rows, columns = coding.block
    return f"# {coding.name}: {coding.codes} codes of blocks of {bins} bins x {rows} rows x {columns} columns"


def codes_text(coding: CodingTensor, *, int8: bool = False) -> str:
    """Return the text form: comments with #, then for each factor a row a code, numbers apart by spaces."""
    lines = [_heading(coding)]
    if int8:
        exact = quantised(coding)
        factors = [("temporal", exact.temporal, exact.temporal_scale), ("spatial", exact.spatial, exact.spatial_scale)]
    else:
        spatial = None if coding.spatial is None else coding.spatial.numpy()
        factors = [("temporal", coding.temporal.numpy(), 1.0), ("spatial", spatial, 1.0)]
    for name, values, scale in factors:
        if values is None:
            continue
        step = f", int8, one step is {scale:.9g}" if int8 else ""
        lines.append(f"# {name}, shape {' x '.join(map(str, values.shape))}{step}")
        for row in values.reshape(coding.codes, -1):
            lines.append(" ".join(str(int(v)) if int8 else f"{v:.9g}" for v in row))
    return "\n".join(lines) + "\n"
