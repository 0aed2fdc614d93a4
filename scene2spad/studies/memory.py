"""`study memory`: what compressive histograms save in the sensor and on the way out of it (supplement S.6, Figures 15
and 16, Table 1), and the section's statements recomputed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm

from csph.codes.design import Design
from csph.evaluation.memory import (
    SEPARABLE_FACTOR,
    best_blocks,
    data_compression,
    memory_compression,
    separable_factor,
)
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import save
from scenes.progress import Progress

COUNTS = 10.0 ** np.arange(6, 10)
BLOCKS = 10.0 ** np.arange(7)
CODES = (64, 128, 256, 512)
NAMED_BLOCKS = ((256, 4, 4), (1024, 4, 4), (256, 8, 8), (256, 2, 2), (64, 4, 4))


def run(command: Study, progress: Progress) -> dict:
    """Run the study: both figures; their numbers, by K and then by N and B; the section's statements."""
    command.out.mkdir(parents=True, exist_ok=True)
    tables: dict[str, dict[int, dict[str, np.ndarray]]] = {}
    drawn: list[str] = []
    for name, factor, title in (
        ("memory-full", 1.0, "full coding tensors (Figure 15)"),
        ("memory-separable", SEPARABLE_FACTOR, f"separable coding tensors, {SEPARABLE_FACTOR:g} x smaller (Figure 16)"),
    ):
        progress(name, 0.5 * len(drawn))
        tables[name] = ratios(factor)
        drawn.append(str(_draw(tables[name], title, command.out / f"{name}.png")))
    plain = {name: {str(k): {what: grid.tolist() for what, grid in r.items()} for k, r in table.items()}
             for name, table in tables.items()}  # fmt: skip
    result = {"figures": drawn, "statements": statements()}
    return {**result, "ratios": plain, "counts": COUNTS.tolist(), "blocks": BLOCKS.tolist()} if command.json else result


def ratios(factor: float) -> dict[int, dict[str, np.ndarray]]:
    """Return {K: {in-sensor storage, data transfer: compression ratios (N, B)}} for coding tensors of M / factor
    numbers."""
    counts, blocks = COUNTS[:, None], BLOCKS[None, :]
    return {
        codes: {
            "in-sensor storage": memory_compression(counts, blocks, codes, factor),
            "data transfer": data_compression(counts, blocks, codes),
        }
        for codes in CODES
    }


def statements() -> list[dict[str, object]]:
    """Return what S.6 says, what is printed there, and the same from the equations of Table 1."""
    blocks = {" x ".join(map(str, block)): block for block in NAMED_BLOCKS}
    sizes = {name: float(Design("learned", block, 64).parameters // 64) for name, block in blocks.items()}
    factors = {name: separable_factor(*block) for name, block in blocks.items()}
    least = {
        f"{name}, N = {n:g}": float(memory_compression(n, n / math.prod(blocks[name]), 512, factors[name]))
        for name in ("256 x 4 x 4", "1024 x 4 x 4")
        for n in COUNTS
    }
    thin = [1e9 / ends / SEPARABLE_FACTOR for ends in (1e5, 1e3)]
    return [
        _statement(
            "a block as large as the tensor (M = N) needs more memory than the histogram",
            "holds for every K",
            {f"storage ratio, N = {n:g}, K = 1": float(memory_compression(n, 1, 1)) for n in COUNTS},
        ),
        _statement(
            "blocks that balance storage and transfer, N = 1e9, full tensors: 10,000 to 100,000",
            "holds: storage is least at sqrt(N)",
            {"blocks": float(best_blocks(1e9)), "M from": 1e9 / 1e5, "M to": 1e9 / 1e4},
        ),
        _statement(
            "the same, separable tensors 16 times smaller: 1,000 to 100,000 blocks, 625 to 62,500 numbers a tensor",
            "holds: storage is least at sqrt(N / 16)",
            {"blocks": float(best_blocks(1e9, SEPARABLE_FACTOR)), "numbers from": thin[0], "numbers to": thin[1]},
        ),
        _statement(
            "of the separable tensors used, 272 and 1,040 numbers approximately match that range",
            "off: 272 lies below it",
            sizes,
        ),
        _statement(
            "a separable tensor is about 16 times smaller than a full one",
            "for 256 x 4 x 4 and 1024 x 4 x 4; not for the other blocks of the paper",
            factors,
        ),
        _statement(
            "separable tensors reduce memory for N of 1e7 and more (here K = 512, the worst)",
            "holds, and from 1e6 on already",
            least,
        ),
        _statement(
            "captions of Figures 15 and 16: tensor sizes (B) and number of histograms (B)", "off: sizes are N", {}
        ),
    ]


def _statement(claim: str, verdict: str, recomputed: dict[str, float]) -> dict[str, object]:
    return {"claim": claim, "verdict": verdict, "recomputed": recomputed}


def _draw(table: dict[int, dict[str, np.ndarray]], title: str, path: Path) -> Path:
    """One row a K: in-sensor storage and data transfer over N and B, with the ratio in every cell."""
    figure, grid = plt.subplots(len(table), 2, figsize=(13, 2.7 * len(table)), layout="constrained")
    for axes_row, (codes, shown) in zip(grid, table.items(), strict=True):
        for axes, (what, values) in zip(axes_row, shown.items(), strict=True):
            _heatmap(axes, values, f"{what}, K = {codes}")
    figure.suptitle(f"Compression ratios, {title}; below 1 (red) is an expansion")
    return save(figure, path)


def _heatmap(axes: Axes, values: np.ndarray, title: str) -> None:
    shown = axes.imshow(np.log10(values), cmap="RdBu", norm=TwoSlopeNorm(0, -3, 7), aspect="auto", origin="lower")
    for (row, column), value in np.ndenumerate(values):
        dark = not -1.5 < np.log10(value) < 4
        axes.text(column, row, _format_value(value), ha="center", va="center", fontsize=7, color="w" if dark else "k")
    axes.set_title(title, fontsize=10)
    axes.set_xticks(range(len(BLOCKS)), [f"$10^{i}$" for i in range(len(BLOCKS))])
    axes.set_yticks(range(len(COUNTS)), [f"$10^{int(np.log10(n))}$" for n in COUNTS])
    axes.set(xlabel="compressive histograms B", ylabel="counts N")
    axes.figure.colorbar(shown, ax=axes, pad=0.01).set_label("log$_{10}$ ratio", fontsize=8)


def _format_value(value: float) -> str:
    return f"{value:,.0f}" if 100 <= value < 1e5 else f"{value:.2g}"
