"""Tables of the emulated programs, their proofs and their costs: no photons, and no torch."""

from __future__ import annotations

import numpy as np

from csph.codes.waves import truncated_waves
from scenes.progress import Progress
from ultraphase import Method, method
from ultraphase.catalog import PUBLISHED
from ultraphase.power import Cost, measured_cost
from ultraphase.tables import INT8_SCALE, int8_codes
from ultraphase.verify import verify


def int8_temporal(method: Method) -> np.ndarray | None:
    """Return the csph truncated-Fourier tensor (K, Mt) of a method in int8 steps; None for coarse histograms."""
    if method.temporal_bins == 0:
        return None
    return int8_codes(truncated_waves(method.codes, method.temporal_bins))


def fixed_spatial(method: Method) -> np.ndarray | None:
    """Return spatial weights (rows, columns, K) in int8 steps that stand in for learned ones where none are given: all
    pixels of a block alike. None for a method without a block."""
    return None if method.block == (1, 1) else np.full((*method.block, method.codes), INT8_SCALE, np.int64)


def verified(method: Method) -> dict:
    """Return proof of one program against its integer matrix, as numbers for a table."""
    temporal = int8_temporal(method)
    program = method.program()
    proof = verify(program, method.matrix(temporal), method.tables(temporal), saturates=method.saturates)
    return {
        "name": method.name,
        "words": len(program.instructions),
        "ram_bits": program.ram_bits,
        "timestamps": len(proof.table),
        "states": proof.states,
        "clocks_min": int(proof.clocks.min()),
        "clocks_mean": float(proof.clocks.mean()),
        "clocks_max": int(proof.clocks.max()),
        "overflow": "saturates" if proof.saturates.any() else "wraps",
    }


def all_costs(progress: Progress, methods: list[Method] | None = None) -> dict[str, Cost]:
    """Return emulated cost of every method by its name."""
    chosen = methods or [method(name) for name in PUBLISHED]
    costs = {}
    for number, one in enumerate(chosen):
        progress(one.name, number / len(chosen))
        costs[one.name] = measured_cost(one, int8_temporal(one))
    return costs
