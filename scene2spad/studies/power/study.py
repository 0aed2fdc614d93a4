"""`study power`: Supplementary Figures 4 and 5, from emulated programs on a rendered scene; the front of depth error
against power, bytes and clocks."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import astuple
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from render.engine import render
from scene2spad.emulation.emulated_chain import Emulated, by_torch, decode, emulate, shared_core_depths
from scene2spad.emulation.program_tables import all_costs, int8_temporal
from scene2spad.networks.lookup import found_only
from scene2spad.options.experiments import Study
from scene2spad.plots import figures
from scene2spad.plots.figures import DEPTH_COLOURS, plt
from scene2spad.studies.power.front import designs, front_rows, loss_rows, printed_rows
from scene2spad.studies.power.front_figure import draw_front
from scene2spad.studies.power.plan import WANTED
from scenes.errors import InputError, require
from scenes.files import read_arrays, whole_file, write_csv
from scenes.library.catalog import load_scene
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.estimators.depth import histogram_errors
from spad.measurements.histogram import Histogram
from spad.sensor.model import PRESETS, PhotonBudget
from ultraphase import Method, method
from ultraphase.assembly.isa import encode
from ultraphase.catalog import PUBLISHED
from ultraphase.core import Counters
from ultraphase.power import READINGS, Cost, Load, as_csv, power, reference_bits, table

log = logging.getLogger("scene2spad")

ONE_BUDGET = PhotonBudget(10.0, 10.0)  # a SPAD: sixteen of them stay within 16 bits
SPATIAL = "all four pixels alike, standing in for learned weights"


def run(command: Study, progress: Progress) -> dict:
    """Run the study: the table, its bars, and the depth that each program's codes give; figures and a CSV in
    `command.out`."""
    out = command.out
    require(out.is_dir() or not out.exists(), f"{out}: is a file, expected a folder for the results")
    for name, size in (("width", command.width), ("height", command.height)):
        require(size > 0 and size % 4 == 0, f"{name} {size}: expected a multiple of 4, as 4 x 4 pixels share a core")
    budget, sensor = PhotonBudget(command.signal, command.background), PRESETS["reference"]
    scene = load_scene(command.scene, seed=command.seed, width=command.width, height=command.height)
    transient = render(scene, seed=command.seed, progress=lambda what, fraction: progress(what, 0.1 * fraction))
    histogram = sense(transient, sensor, budget, seed=command.seed)
    out.mkdir(parents=True, exist_ok=True)
    depths, rows = _depths(histogram, out, progress)
    dim = sense(transient, sensor, ONE_BUDGET, seed=command.seed)
    progress("4 x 4 SPADs a core", 0.9)
    shared = shared_core_depths(dim)
    costs = all_costs(lambda what, fraction: progress(what, 0.9 + 0.1 * fraction))
    printed = table(costs)
    with whole_file(out / "ultraphase.csv") as beside:
        beside.write_text(as_csv(printed))
    errors = {name: _errors(depth, dim) for name, depth in shared.items()}
    models = found_only(WANTED, command)
    found = designs(models.found)
    front = front_rows(found, transient, command.seed, progress)
    losses, print_points = loss_rows(found, command.seed, progress), printed_rows()
    made = [
        out / "ultraphase.csv",
        write_csv(front, out / "ultraphase-front.csv"),
        write_csv(losses, out / "ultraphase-lost.csv"),
    ]
    drawn = [
        draw_front(found, front, losses, print_points, out / "ultraphase-front.png"),
        draw_power(costs, out / "ultraphase-power.png"),
        draw_depths(histogram, depths, rows, out / "ultraphase-depth.png"),
        _draw_shared(dim, shared, errors, out / "ultraphase-shared-core.png"),
    ]
    return {
        "rows": printed,
        "depth": rows,
        "shared_core": errors,
        "front": front,
        "lost_photons": losses,
        "front_published": print_points,
        "front_absent": [one.name for one in models.absent],
        "spatial_weights": SPATIAL,
        "readings": READINGS,
        "figures": [str(path) for path in drawn],
        "csv": [str(path) for path in made],
        "out": str(out),
    }


def _errors(depth: np.ndarray, histogram: Histogram) -> dict:
    found = histogram_errors(depth, histogram)
    return {name: found[name] for name in ("mae_mm", "within_10mm", "median_abs_mm")}


def _depths(histogram: Histogram, out: Path, progress: Progress) -> tuple[dict[str, np.ndarray], list[dict]]:
    """Depth of every published program's codes, and what the emulation counted beside its error."""
    depths, rows = {}, []
    for number, name in enumerate(PUBLISHED):
        progress(name, 0.1 + 0.8 * number / len(PUBLISHED))
        chosen = method(name)
        found = _emulated(histogram, chosen, out)
        depths[name] = decode(found.codes, chosen, histogram.sensor)
        counted = found.counters
        rows.append(
            {
                "name": name,
                **_errors(depths[name], histogram),
                "bytes_per_pixel": found.bits / 8 / histogram.depth_m.size,
                "photons": counted.photons,
                "cycles": counted.cycles,
                "wraps": counted.wraps,
                "saturations": counted.saturations,
                "differs_from_torch": int(np.count_nonzero(found.codes != by_torch(histogram.counts, chosen))),
            }
        )
    return depths, rows


def _emulated(histogram: Histogram, chosen: Method, out: Path) -> Emulated:
    """Every core of the image interpreted to its last photon; read back where an earlier run has finished it.

    The file's name holds a hash of the photons and of all that the cores do with them.
    """
    program = chosen.program()
    sha = hashlib.sha256(histogram.sha256().encode())
    sha.update(repr([encode(one) for one in program.instructions]).encode() + repr(program.regions).encode())
    for contents in chosen.tables(int8_temporal(chosen)).values():
        sha.update(contents.tobytes())
    path = out / "emulated" / f"{chosen.name}-{sha.hexdigest()[:16]}.npz"
    if path.is_file():
        try:
            kept = read_arrays(path)
            return Emulated(kept["codes"], Counters(*kept["counters"].tolist()), int(kept["bits"]))
        except (InputError, KeyError, TypeError):
            log.warning("%s cannot be read, and is made again", path)
    found = emulate(histogram.counts, chosen)
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as beside:
        np.savez(beside, codes=found.codes, counters=astuple(found.counters), bits=found.bits)
    return found


def draw_power(costs: dict[str, Cost], path: Path) -> Path:
    """Draw Supplementary Figure 4a: processing and readout power of 2 x 2 cores at 30 fps and 550 photons, in both
    readings, from printed and from emulated clocks, with the two uncompressed readouts beside them."""
    load = Load()
    printed = {name: power(Cost(row.clocks, 0, 8 * row.bytes_per_pixel), load) for name, row in PUBLISHED.items()}
    ours = {name: power(cost, load) for name, cost in costs.items()}
    bare = {name: power(Cost(0, 0, bits), load) for name, bits in reference_bits(load.photons).items()}
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    for one, field, title in (
        (axes[0], "processing_published_w", "processing, as published\n(Joules an operation x duty, called Watts)"),
        (axes[1], "processing_energy_w", "processing, energy x rate\n(94.6 GOPS/W; inferred)"),
    ):
        _bars(one, {"printed clocks": printed, "emulated clocks": ours}, field, title)
    end = [1e6 * found.frame_end_energy_w for found in ours.values()]
    axes[1].plot(range(len(end)), end, "kx", label="frame end, emulated (not in the published table)")
    axes[1].set_ylim(0.5 * min(end), None)
    axes[1].legend(fontsize=8, loc="upper left")
    readout = {**printed, **bare}
    _bars(axes[2], {"readout": readout}, "readout_w", "readout interface\n(rate x 5 pF x (3.3 V)²)")
    figure.suptitle("2 x 2 cores, 30 frames a second, 550 photons a pixel and frame")
    return figures.save(figure, path)


def _bars(axes: Axes, groups: dict[str, dict], field: str, title: str) -> None:
    wide = 0.8 / len(groups)
    for number, (label, found) in enumerate(groups.items()):
        at = np.arange(len(found)) + (number - (len(groups) - 1) / 2) * wide
        values = [1e6 * getattr(one, field) for one in found.values()]
        shown = axes.bar(at, values, wide, label=label)
        axes.bar_label(shown, [f"{value:.2g}" for value in values], fontsize=7, padding=2, rotation=90)
    names = list(next(iter(groups.values())))
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
    axes.set(yscale="log", ylabel="power of 2 x 2 pixels [µW]", title=title)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 8)
    axes.legend(fontsize=8, loc="upper left")


def draw_depths(histogram: Histogram, depths: dict[str, np.ndarray], rows: list[dict], path: Path) -> Path:
    """Draw Supplementary Figure 4b: the truth and the depth from every program's codes, on one scale."""
    errors = {row["name"]: row for row in rows}
    titles = {
        name: f"{name}: {errors[name]['bytes_per_pixel']:.0f} B a pixel\n"
        f"MAE {errors[name]['mae_mm']:.0f} mm, median of |error| {errors[name]['median_abs_mm']:.0f} mm\n"
        f"{errors[name]['wraps']:,} wraps, {errors[name]['saturations']:,} saturations"
        for name in depths
    }
    level = f"{histogram.budget.signal:g} signal and {histogram.budget.background:g} background photons a pixel"
    return _draw_maps(histogram, depths, titles, f"Depth from emulated cores, {level}", 4, path)


def _draw_shared(histogram: Histogram, depths: dict, errors: dict, path: Path) -> Path:
    titles = {
        name: f"{name}\nMAE {errors[name]['mae_mm']:.0f} mm, median of |error| {errors[name]['median_abs_mm']:.0f} mm"
        for name in depths
    }
    level = f"{histogram.budget.signal:g} signal and {histogram.budget.background:g} background photons a SPAD"
    return _draw_maps(histogram, depths, titles, f"4 x 4 SPADs on one core, Fourier K = 8, {level}", 3, path)


def _draw_maps(histogram: Histogram, maps: dict, titles: dict, title: str, columns: int, path: Path) -> Path:
    """Draw the truth, then maps on its scale."""
    all_maps = {"truth": histogram.depth_m, **maps}
    lines = -(-len(all_maps) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(3.4 * columns, 3.1 * lines), layout="constrained")
    known = histogram.depth_m[np.isfinite(histogram.depth_m)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    for one, (name, depth) in zip(axes.flat, all_maps.items(), strict=False):
        shown = one.imshow(depth, cmap=DEPTH_COLOURS, vmin=low, vmax=high, interpolation="nearest")
        one.set_title(titles.get(name, name), fontsize=9)
        one.set_xticks([])
        one.set_yticks([])
    for unused in list(axes.flat)[len(all_maps) :]:
        unused.axis("off")
    figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.02).set_label("depth [m]")
    figure.suptitle(title)
    return figures.save(figure, path)
