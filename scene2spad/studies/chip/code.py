"""A trained model's codes in the chip's integers: tables for `ultraphase.compiler`, and the same numbers by torch."""

from __future__ import annotations

import hashlib
import math
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch

from csph.codes.blocks import encode_blocks
from csph.codes.design import Design
from csph.codes.quantise import wrapped_sums
from csph.codes.temporal import block_pulse, gray_frequencies
from csph.codes.tensor import CodingTensor
from csph.layer import CompressiveLayer
from csph.networks.model import DepthModel
from scene2spad.options.experiments import MAX_HEADROOM_BITS
from scene2spad.studies.chip.plan import HEADROOM_BITS
from scenes.errors import InputError, require
from spad.sensor.model import Sensor
from ultraphase.assembly.program import listing
from ultraphase.catalog import TIMESTAMPS
from ultraphase.compiler import Compiled, compile_code
from ultraphase.integer_code import IntegerCode, folded_temporal
from ultraphase.tables import block_sum, require_waves

COUNTER_LIMIT = 255


@dataclass(frozen=True, eq=False)
class ChipModel:
    """A trained model and its codes as the chip runs them.

    scale    what one step of the integers that leave the sensor is worth in the model's codes
    reader   the model with the chip's tensor in its layer: what left the sensor is back-projected with what it was
             made with. With the model's own float tensor the late even harmonics of a quarter wave cost 1 to 2 mm of
             bias (256 bins; measured)
    """

    model: DepthModel
    compiled: Compiled
    scale: float
    reader: DepthModel

    def digest(self, of_model: str) -> str:
        """Return what results are kept by: the model's own digest, with the program and the tables on the chip."""
        sha = hashlib.sha256(f"{of_model} {self.compiled.source}".encode())
        for values in self.compiled.tables(self.compiled.block).values():
            sha.update(np.ascontiguousarray(values).tobytes())
        return sha.hexdigest()


def compile_model(model: DepthModel, name: str) -> ChipModel:
    """Compile a model's codes. Raises InputError for a model without codes, a sensor of other than 1,024 bins, and
    what `compile_code` refuses."""
    require(model.layer is not None, f"model {name}: has no codes to compile, its network sees all bins")
    bins = model.config.sensor.bins
    require(bins == TIMESTAMPS, f"model {name}: sensor of {bins} bins, the chip's timestamps count {TIMESTAMPS}")
    layer, design = model.codes_layer, model.config.codes_design
    coding = layer.coding()
    if _is_histogram(design, coding):
        code = IntegerCode(name, coding.temporal.round().to(torch.int8).numpy(), counters=True)
        return ChipModel(model, compile_code(code), 1.0, model)
    steps = layer.quantised()
    spatial = steps.spatial if coding.rows * coding.columns > 1 else None
    temporal = steps.temporal
    if temporal.ndim == 4 and temporal.shape[2:] == (1, 1):
        temporal = temporal[:, :, 0, 0]
    code = IntegerCode(name, temporal, spatial, harmonics_of(design, temporal, model.config.sensor))
    scale = steps.temporal_scale * (1.0 if spatial is None else steps.spatial_scale) * (1 << code.output_shift)
    own = folded_temporal(code) if code.harmonics else temporal
    weights = None if spatial is None else _as_float(spatial, steps.spatial_scale)
    chip_coding = CodingTensor(name, _as_float(own, steps.temporal_scale), weights)
    return ChipModel(model, compile_code(code), scale, _reader(model, chip_coding))


def _as_float(steps: np.ndarray, scale: float) -> torch.Tensor:
    return torch.from_numpy(steps.astype(np.float32) * np.float32(scale))


def with_headroom(model: DepthModel, bits: int) -> DepthModel:
    """Return a float model with its codes in 8 bits, temporal ones `bits` bits smaller: sums wrap at 2^bits times the
    photons, and rounding is so much coarser. Its network and weights stay as they are: it sees codes normalised.

    Raises InputError for a model without codes, codes that `int8` is not for, or bits outside 0 to MAX_HEADROOM_BITS.
    """
    good = 0 <= bits <= MAX_HEADROOM_BITS
    require(good, f"headroom of {bits} bits, expected 0 to {MAX_HEADROOM_BITS} of the 7 that a code has")
    require(model.layer is not None, f"{model.config.name}: has no codes to give headroom to")
    wide = DepthModel(replace(model.config, layer={**model.config.layer, "int8": True}), own=model.own_codes)
    wide.begin_with(model)
    with torch.no_grad():
        logarithms = wide.codes_layer.temporal_range
        assert logarithms is not None  # an int8 layer has it
        logarithms.add_(bits * math.log(2))
    return wide.eval()


def headroom_of(model: DepthModel) -> int:
    """Return the bits of headroom that `ultraphase compile` gives a model by default.

    One costs nothing that was measured, and keeps bright pixels from wrapping (docs/ultraphase.md); a model that was
    trained for the chip has its own ranges, gates only count, and full
    tensors are too large for the chip.
    """
    layer, design = model.layer, model.config.design
    fixed = layer is None or design is None or layer.options.int8 or design.code == "coarse" or design.full
    return 0 if fixed else HEADROOM_BITS


def _reader(model: DepthModel, coding: CodingTensor) -> DepthModel:
    """Return the model with another coding tensor, taken as it is, in the place of its own."""
    options = replace(model.codes_layer.options, zero_mean=False, pulse_in_codes=False, int8=False)
    reader = deepcopy(model)
    reader.layer = CompressiveLayer(coding, options=options, sensor=model.config.sensor)
    return reader


def _is_histogram(design: Design, coding: CodingTensor) -> bool:
    """Gates over all timestamps, as trained with: 0 and 1."""
    plain = bool(((coding.temporal == 0) | (coding.temporal == 1)).all())
    return design.code == "coarse" and design.block == (TIMESTAMPS, 1, 1) and plain


def harmonics_of(design: Design, temporal: np.ndarray, sensor: Sensor) -> tuple[int, ...]:
    """Return harmonics of a Fourier code that one quarter wave gives back within a step of its phase; none of another.

    Codes that hold the pulse have waves of different heights: they are a table.
    """
    bins, count = design.block[0], design.codes // 2
    if design.code not in ("fourier", "gray") or bins % 4 or bins < 8:
        return ()
    gray = design.code == "gray"
    found = gray_frequencies(block_pulse(bins, sensor))[:count] if gray else list(range(1, count + 1))
    try:
        require_waves(temporal, found, "code")
    except InputError:
        return ()
    return tuple(found)


def codes_by_torch(counts: np.ndarray, compiled: Compiled) -> np.ndarray:
    """Return integers that leave the sensor, without a program: strided products with the int8 tensor
    (`encode_blocks`), in the chip's number formats. counts (H, W, 1024) -> (H / Mr, W / Mc, numbers) int64.

    Every core's sums are exact in float64, then wrap at 16 bits (8-bit counters saturate).
    """
    height, width, _ = counts.shape
    rows, columns = compiled.block
    histogram = torch.from_numpy(np.ascontiguousarray(counts.transpose(2, 0, 1)))[None, None]
    held = np.empty((height, width, compiled.matrix.shape[2]), np.int64)
    for row in range(rows):
        for column in range(columns):
            weights = torch.from_numpy(compiled.matrix[row, column].astype(np.float64))[..., None, None]
            sums = encode_blocks(histogram[..., row::rows, column::columns], weights)[0, :, 0]
            held[row::rows, column::columns] = sums.permute(1, 2, 0).round().numpy()
    return leave_sensor(held, compiled)


def leave_sensor(sums: np.ndarray, compiled: Compiled) -> np.ndarray:
    """Return what a frame's end makes of the exact sums of every core: (H, W, numbers) -> (H / Mr, W / Mc, numbers)
    int64."""
    if compiled.code.counters:
        return np.minimum(sums, COUNTER_LIMIT)
    held = wrapped_sums(torch.from_numpy(sums)).numpy()
    (rows, columns), (height, width) = compiled.block, sums.shape[:2]
    if (rows, columns) == (1, 1):
        return held
    cores = held.reshape(height // rows, rows, width // columns, columns, -1, compiled.code.codes).swapaxes(1, 2)
    cores = cores.reshape(height // rows, width // columns, rows * columns, -1, compiled.code.codes)
    weights = None if compiled.weights is None else compiled.weights.reshape(rows * columns, -1)
    summed = block_sum(cores, weights, compiled.code.output_shift)
    return summed.reshape(height // rows, width // columns, -1)


def listing_with_tables(compiled: Compiled) -> str:
    """Return the program's listing, then the contents of its tables, those of each core of a block one after the
    other."""
    lines = [listing(compiled.program, compiled.chip)]
    rows, columns = compiled.block
    for name, values in compiled.tables(compiled.block).items():
        if values.ndim == 1:
            lines.append(f"; table {name}: {' '.join(map(str, values))}\n")
            continue
        for row in range(rows):
            for column in range(columns):
                numbers = " ".join(map(str, values[row, column]))
                lines.append(f"; table {name} of core ({row}, {column}): {numbers}\n")
    return "".join(lines)
