"""From a transient, a histogram or a depth map to what its page shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from render.transient import Transient
from scene2spad.plots.pixels import expected_name
from scene2spad.viewer.content import METRES_PER_NS, NS_PER_M, Content, Cube, Layer, Returns, grey_layer
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.json_types import JsonObject
from spad.detection.rates import Rates, rates_for
from spad.estimators.bistatic import (
    baseline_of,
    pixel_directions,
    pointing_of,
    time_tells_depth,
    true_arrival_s,
    true_path_m,
)
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor
from spad.sensor.pulse import REACH_SIGMAS

FRAMES = 256  # bins of path length of a transient that no sensor has seen
TAIL = 0.999  # share of the light that these span
DIRECT_NS, INDIRECT_NS = 0.05, 1.0  # returns of a pixel that come closer together are one line
BLOCK = 1024  # pixels whose rates are computed at once
FINER = 4  # cells of a bin that rates are found from
POINT = 1e-3  # cells below which a return has no length
MIXED_LOW, MIXED_HIGH = 0.0, 1.0


def transient_content(transient: Transient, title: str) -> Content:
    """Show a transient: its images, its light over path length, its returns and its surface."""
    total = transient.total_radiance()
    direct = transient.bounces == 1
    late = np.bincount(transient.return_pixel[~direct], transient.radiance[~direct], total.size).reshape(total.shape)
    fraction = np.divide(late, total, out=np.zeros_like(total), where=total > 0)
    layers = (
        grey_layer("laser light", "1/(m² sr)", total),
        depth_layer("depth", transient.depth_m),
        Layer("indirect share", "", fraction, "error", 0.0, float(fraction.max(initial=0)) or 1.0),
        grey_layer("ambient light", "W/(m² sr nm)", transient.ambient),
        Layer("two surfaces", "", transient.mixed, "gray", MIXED_LOW, MIXED_HIGH),
    )
    return Content(
        title,
        transient_facts(transient),
        layers,
        (light_over_path(transient),),
        merged_returns(transient, 1.0, "1/(m² sr)"),
        true_path_m(transient) * NS_PER_M,
        **surface(transient.depth_m, transient.meta, total),
    )


def histogram_content(histogram: Histogram, title: str, transient: Transient | None = None) -> Content:
    """Show a histogram: its images, detections, and with its transient the expected counts and the returns."""
    sensor, counted = histogram.sensor, histogram.counts.sum(axis=2, dtype=np.int64)
    layers = [grey_layer("detections", "", counted)]
    if histogram.signal_known:
        layers += [
            grey_layer("expected signal", "photons", histogram.expected_signal),
            grey_layer("expected background", "photons", histogram.expected_background),
        ]
    if np.isfinite(histogram.depth_m).any():
        layers += [
            depth_layer("true depth", histogram.depth_m),
            Layer("two surfaces", "", histogram.mixed, "gray", MIXED_LOW, MIXED_HIGH),
        ]
    cubes = [detections(histogram)]
    returns, notes = None, []
    if transient is None:
        notes.append("Expected counts and returns are in the transient: lay it beside the histogram, or give it.")
    else:
        rates = rates_for(transient, sensor, histogram.budget, seed=int(histogram.meta.get("seed", 0)))
        expected = expected_cube(transient, sensor, rates)
        cubes.append(replace(cubes[0], name=expected_name(histogram), values=expected, drawn="line"))
        returns = merged_returns(transient, rates.signal_scale, "photons", period_ns=1e9 * sensor.period_s)
    cloud = surface(histogram.depth_m, pointing_of(histogram.meta), counted)
    arrival_ns, record_ns = 1e9 * true_arrival_s(histogram), 1e9 * sensor.bins * sensor.bin_width_s
    missed = int((arrival_ns >= record_ns).sum())
    if missed:
        notes.append(f"Light from the true depth of {missed:,} pixels arrives after the record's {record_ns:.4g} ns.")
    return Content(
        title, histogram_facts(histogram), tuple(layers), tuple(cubes), returns, arrival_ns, notes=notes, **cloud
    )


def detections(histogram: Histogram) -> Cube:
    """Return the counts of a histogram over time."""
    step_ns = 1e9 * histogram.sensor.bin_width_s
    depth = METRES_PER_NS if time_tells_depth(histogram) else None
    return Cube("detections", "per bin", histogram.counts, 0.0, step_ns, "bars", depth)


def depth_content(depth_m: np.ndarray, confidence: np.ndarray | None, meta: JsonObject, title: str) -> Content:
    """Show a depth map: depth, confidence where the file states it, and the points."""
    layers = [depth_layer("depth", depth_m)]
    if confidence is not None:
        layers.append(Layer("confidence", "", confidence, "gray", 0.0, 1.0))
    facts = {"kind": "depth map", "method": str(meta.get("method", "")), "pixels": _size(depth_m)}
    return Content(title, facts, tuple(layers), **surface(depth_m, meta, confidence))


def depth_layer(name: str, depth_m: np.ndarray) -> Layer:
    from scene2spad.plots.figures import depth_limits

    limits = depth_limits(depth_m)
    return Layer(name, "m", depth_m, "depth", limits["vmin"], limits["vmax"])


def surface(depth_m: np.ndarray, pointing: JsonObject, value: np.ndarray | None) -> JsonObject:
    """Return points (N, 3) in the camera's frame and their brightness; nothing where it is not known where the pixels
    look (`spad.estimators.bistatic.pixel_directions`)."""
    directions = pixel_directions(pointing, depth_m.shape)
    if directions is None:
        return {}
    known = np.isfinite(depth_m)
    points = (directions * depth_m[..., None])[known].astype(np.float32)
    if value is None:
        return {"points": points}
    seen = value[known].astype(float)
    top = float(np.quantile(seen, 0.98)) if seen.size else 1.0
    return {"points": points, "point_value": np.clip(seen / (top or 1.0), 0, 1)}


def light_over_path(transient: Transient) -> Cube:
    """Return radiance of every pixel over FRAMES equal steps of path length, each return spread evenly over its
    interval."""
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    low, high = _span(near, far, transient.radiance)
    step = (high - low) / FRAMES
    seen = near < high
    cube = np.zeros((transient.height * transient.width, FRAMES))
    spread(cube, transient.return_pixel[seen], (near[seen] - low) / step, (far[seen] - low) / step,
           transient.radiance[seen])  # fmt: skip
    shape = (transient.height, transient.width, FRAMES)
    start_ns, step_ns, depth = (
        low * NS_PER_M,
        step * NS_PER_M,
        None if any(baseline_of(transient.meta)) else METRES_PER_NS,
    )
    return Cube("light", "1/(m² sr) per step", cube.reshape(shape), start_ns, step_ns, "line", depth)


def spread(cube: np.ndarray, row: np.ndarray, near: np.ndarray, far: np.ndarray, energy: np.ndarray) -> None:
    """Add returns, each uniform from `near` to `far` (in cells), to rows of a cube (P, T); what lies beyond T is left
    out, what begins before 0 begins there."""
    rows, cells = cube.shape
    near, far = np.maximum(near, 0), np.maximum(far, 0)
    length = far - near  # before the cut: what lies beyond T has its part of the energy
    near, far = np.minimum(near, cells), np.minimum(far, cells)
    point = length < POINT
    ramps = np.zeros((rows, cells + 2))
    # the light that has arrived rises with a constant slope from `near` to `far`: each kink's slope, then summed
    for place, sign in ((near[~point], 1.0), (far[~point], -1.0)):
        cell = np.floor(place).astype(np.int64)
        slope = sign * energy[~point] / length[~point]
        np.add.at(ramps, (row[~point], cell), slope * (1 - (place - cell)))
        np.add.at(ramps, (row[~point], cell + 1), slope * (place - cell))
    cube += np.clip(np.cumsum(ramps, axis=1)[:, :cells], 0, None)  # sums of kinks end a rounding beside 0
    inside = point & (near < cells)
    np.add.at(cube, (row[inside], np.floor(near[inside]).astype(np.int64)), energy[inside])


def _span(near: np.ndarray, far: np.ndarray, radiance: np.ndarray) -> tuple[float, float]:
    if not len(near):
        return 0.0, 1.0
    order = np.argsort(far, kind="stable")
    passed = np.cumsum(radiance[order], dtype=float)
    end = far[order[int(np.searchsorted(passed, TAIL * passed[-1]))]] if passed[-1] > 0 else far.max()
    low = float(near.min())
    margin = 0.01 * (float(end) - low) + 0.01
    return max(low - margin, 0.0), float(end) + margin


def merged_returns(transient: Transient, scale: float, unit: str, *, period_ns: float = math.inf) -> Returns:
    """Make one line of the returns of a pixel that lie in one cell of time and are of one kind: energies are summed,
    times weighted by energy. Time wraps at the laser's period."""
    time = np.fmod(0.5 * (transient.path_near_m.astype(float) + transient.path_far_m) * NS_PER_M, period_ns)
    direct = transient.bounces == 1
    cell = np.floor(time / np.where(direct, DIRECT_NS, INDIRECT_NS)).astype(np.int64)
    cells = int(cell.max(initial=0)) + 1
    key = (transient.return_pixel * 2 + ~direct) * cells + cell
    kinds, place = np.unique(key, return_inverse=True)
    energy = np.bincount(place, transient.radiance, len(kinds))
    moment = np.bincount(place, transient.radiance * time, len(kinds))
    centre = np.bincount(place, time, len(kinds)) / np.maximum(np.bincount(place, minlength=len(kinds)), 1)
    centre = np.divide(moment, energy, out=centre, where=energy > 0)
    owner, late = np.divmod(kinds // cells, 2)
    order = np.lexsort((centre, owner))
    sizes = np.bincount(owner, minlength=transient.height * transient.width)
    note = f"{unit}; lines stand for direct returns within {DIRECT_NS:g} ns and indirect ones within {INDIRECT_NS:g} ns"
    offsets = np.concatenate(([0], np.cumsum(sizes)))
    return Returns(offsets, centre[order], scale * energy[order], late[order] == 0, note)


def expected_cube(transient: Transient, sensor: Sensor, rates: Rates) -> np.ndarray:
    """Return the rates (H, W, T) float32 that detections are drawn from, before pile-up and dead time.

    For looking: light is even in cells of a quarter of a bin. It is off by less than 2 % of a pixel's brightest bin
    where the response's standard deviation is a bin or more, and keeps its sum. The exact rates of a pixel are those of
    `spad.detection.detect.expected_in_pixel`.
    """
    period, edges = sensor.bins_per_period, sensor.code_edges
    fine = period * FINER
    per_cell = SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s / FINER
    pulse = np.fft.rfft(_pulse_in_cells(sensor, fine))
    pixels = transient.height * transient.width
    found = np.empty((pixels, sensor.bins), np.float32)
    alive = rates.signal_scale * rates.alive.reshape(-1)
    for start in range(0, pixels, BLOCK):
        part = slice(start, min(start + BLOCK, pixels))
        mine = slice(int(transient.offsets[part.start]), int(transient.offsets[part.stop]))
        near, far = (path[mine].astype(float) / per_cell for path in (transient.path_near_m, transient.path_far_m))
        short = np.maximum(0.5 * (1 - (far - near)), 0)  # what is shorter than a cell is one cell long
        near, far = near - short, far + short
        turns = np.floor(near / fine) * fine  # time wraps at the period
        periods = int((far - turns).max(initial=0) // fine) + 1
        light = np.zeros((part.stop - part.start, periods * fine))
        spread(light, transient.return_pixel[mine] - start, near - turns, far - turns, transient.radiance[mine])
        light = light.reshape(-1, periods, fine).sum(axis=1)
        # a cell's light stands at its centre, a bin's edge between two of them
        blurred = np.clip(np.fft.irfft(np.fft.rfft(light, axis=1) * pulse, fine, axis=1), 0, None)
        background = (rates.background.reshape(-1)[part] / period)[:, None]
        if rates.converter is None or edges is None:
            signal = blurred.reshape(-1, period, FINER).sum(axis=2)[:, : sensor.bins]
        else:  # the bins cover the period
            own = edges[rates.converter.reshape(-1)[part]]
            signal, background = _between(blurred, own * FINER), background * np.diff(own)
        found[part] = signal * alive[part, None] + background
    return found.reshape(transient.height, transient.width, sensor.bins)


def _pulse_in_cells(sensor: Sensor, fine: int) -> np.ndarray:
    """Return the response to an arrival at the centre of cell 0 of a period of `fine` cells, (fine,), folded."""
    before, after = (math.ceil(part / sensor.period_s) for part in sensor.response.window_s(REACH_SIGMAS))
    edges = np.arange(-before * fine, (after + 1) * fine + 1) - 0.5  # in cells
    masses = sensor.response.bin_masses(edges * (sensor.bin_width_s / FINER))
    return masses.reshape(-1, fine).sum(axis=0)


def _between(light: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return light between neighbouring edges of each row, (P, F), (P, n + 1) in cells -> (P, n)."""
    passed = np.pad(light.cumsum(axis=1), ((0, 0), (1, 1)), mode="edge")
    passed[:, 0] = 0
    cell = np.floor(edges).astype(np.int64)
    before, after = (np.take_along_axis(passed, cell + step, axis=1) for step in (0, 1))
    return np.diff(before + (edges - cell) * (after - before), axis=1)


def transient_facts(transient: Transient) -> dict[str, str]:
    meta = transient.meta
    error = meta.get("relative_error", {}).get("total")
    return {
        "kind": "transient",
        "scene": str(meta.get("scene", "unnamed")),
        "pixels": _size(transient.depth_m),
        "returns": f"{transient.returns:,}",
        "indirect light": f"{transient.indirect_fraction:.1%}",
        "estimated error": "not stated" if error is None else f"{error:.2%}",
        "seed": str(meta.get("seed", "none")),
    }


def histogram_facts(histogram: Histogram) -> dict[str, str]:
    sensor = histogram.sensor
    return {
        "kind": "histogram",
        "sensor": f"{sensor.name}: {sensor.bins} bins of {sensor.bin_width_s * 1e12:.4g} ps",
        "pixels": _size(histogram.depth_m),
        "photon budget": histogram.budget_in_words,
        "detections": f"{int(histogram.counts.sum(dtype=np.int64)):,}",
        "detection law": str(histogram.meta.get("model", "not stated")),
        "seed": str(histogram.meta.get("seed", "none")),
    }


def _size(image: np.ndarray) -> str:
    return f"{image.shape[0]} rows x {image.shape[1]} columns"
