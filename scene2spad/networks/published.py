"""The published numbers of the test set 7 m farther away, and our models on its photographs in that convention.

Five of the eight Middlebury pairs are at hand. As published: depth 3740 px 0.16 m / (disparity + dmin), luma as albedo
and ambient light, images padded to multiples of 64 and shrunk eight times by a cubic kernel, one return a pixel at the
rounded bin. As not: unknown disparities are filled from behind, and everything moves with the offset (theirs left a
part of Bowling1 at 1.962 m).
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from csph.evaluation.methods import DepthEstimator
from csph.evaluation.metrics import image_errors
from csph.levels import PHOTON_LEVELS
from csph.networks.checkpoint import load_model
from csph.networks.grid import published_centroid_bins
from csph.networks.model import DepthModel
from csph.networks.posterior import DECODERS, Decoder
from csph.weights.cards import checkpoint_of
from scene2spad.networks.end_warnings import warn_of_unfinished
from scene2spad.networks.registry import EvaluatedModel, ModelSpec
from scene2spad.networks.results import Store
from scene2spad.networks.unfinished import Unfinished
from scene2spad.options.networks import Evaluate
from scenes.errors import InputError, require
from scenes.files import write_csv
from scenes.io.relief import (
    MIDDLEBURY_BASELINE_M,
    MIDDLEBURY_FOCAL_PX,
    filled,
    middlebury_folder,
    middlebury_names,
    read_disparity,
    read_luma,
)
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.formats.rgbd import PUBLISHED_SPEED_OF_LIGHT_M_PER_S, published_from_rgbd
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

log = logging.getLogger("scene2spad")

SCENES = 8  # of the published test set
SHRINK, PAD_TO = 8, 64
PADLESS_M = 1.962  # of the wall seen through Bowling1's large hole


class Published(NamedTuple):
    """MAE and RMSE [mm] over 8 scenes and 16 levels, as they are and 7 m farther; None where only figures exist."""

    near_mae: float
    near_rmse: float
    far_mae: float | None = None
    far_rmse: float | None = None


# Recorded results of the ICCV 2023 code: design and block -> compression -> numbers.
PUBLISHED: dict[tuple[str, tuple[int, int, int]], dict[int, Published]] = {
    ("learned", (256, 4, 4)): {
        32: Published(9.17, 16.28, 16.88, 75.02),
        64: Published(11.13, 19.69, 17.53, 70.45),
        128: Published(13.29, 24.17, 20.94, 80.82),
        256: Published(15.86, 28.21, 23.83, 86.16),
    },
    ("learned", (1024, 4, 4)): {
        32: Published(8.74, 14.75, 38.14, 158.97),
        64: Published(9.97, 17.46, 27.36, 113.15),
        128: Published(11.91, 21.33, 284.86, 732.83),
        256: Published(15.89, 33.46, 43.31, 143.02),
    },
    ("fourier", (1024, 1, 1)): {
        32: Published(13.8, 21.5, None, 63.0),
        64: Published(23.2, 33.6, None, 76.6),
        128: Published(40.34, 58.31, 43.75, 96.09),
    },
    ("learned", (1024, 1, 1)): {
        32: Published(12.6, 29.8, None, 226.0),
        64: Published(11.9, 22.6, None, 148.0),
        128: Published(29.6, 76.8, None, 240.0),
    },
    ("none", (1, 1, 1)): {1: Published(9.33, 17.57, None, 85.3)},
    ("peak", (1, 1, 1)): {1: Published(14.27, 27.2, None, 127.9)},
    ("gray", (1024, 1, 1)): {32: Published(11.2, 18.6), 64: Published(13.5, 25.6), 128: Published(30.4, 44.2)},
    ("fourier", (256, 1, 1)): {32: Published(13.0, 19.9), 64: Published(21.7, 32.1), 128: Published(663, 782)},
    ("learned", (256, 1, 1)): {32: Published(10.7, 17.7), 64: Published(19.5, 33.5), 128: Published(319, 442)},
    ("learned", (256, 2, 2)): {32: Published(9.19, 15.6), 64: Published(11.5, 19.5), 128: Published(14.3, 25.0)},
    ("learned", (256, 8, 8)): {32: Published(10.3, 18.1), 64: Published(11.4, 20.1), 128: Published(13.5, 23.9)},
    ("learned", (1024, 2, 2)): {32: Published(9.33, 19.5), 64: Published(10.2, 21.7), 128: Published(13.5, 28.3)},
    ("learned", (1024, 8, 8)): {32: Published(9.21, 16.7), 64: Published(10.5, 20.1), 128: Published(11.6, 21.3)},
    ("learned", (64, 4, 4)): {32: Published(10.6, 18.7), 64: Published(12.7, 22.9), 128: Published(16.1, 29.0)},
    ("learned", (16, 4, 4)): {32: Published(16.2, 41.5), 64: Published(76.5, 193), 128: Published(186, 334)},
    ("full learned", (256, 4, 4)): {32: Published(9.07, 15.4), 64: Published(11.3, 19.4), 128: Published(13.1, 23.4)},
    ("full learned", (1024, 4, 4)): {32: Published(9.53, 16.5), 64: Published(9.97, 17.5), 128: Published(11.6, 20.4)},
    ("fourier+learned", (256, 2, 2)): {
        32: Published(8.59, 14.9),
        64: Published(12.3, 19.8),
        128: Published(17.6, 27.0),
    },
    ("fourier+learned", (256, 4, 4)): {
        32: Published(9.30, 18.8),
        64: Published(10.3, 21.3),
        128: Published(12.4, 23.6),
    },
}


def printed(wanted: ModelSpec) -> Published | None:
    """Return what was published of that design at that compression, if it was."""
    design = f"{'full ' if wanted.full else ''}{wanted.design}"
    if not wanted.coded:
        return PUBLISHED[design, (1, 1, 1)][1]
    return PUBLISHED.get((design, wanted.block), {}).get(wanted.compression)


@dataclass(frozen=True, eq=False)
class Pair:
    """A photograph and its depth at the published test set's size, (72, 88) or smaller."""

    name: str
    depth_m: np.ndarray
    luma: np.ndarray

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.depth_m.tobytes() + self.luma.tobytes()).hexdigest()[:32]


def pairs(count: int | None = None) -> list[Pair]:
    """Return the pairs found beside the project, at most `count`. Raises InputError where there are none."""
    return [_pair(middlebury_folder(name)) for name in middlebury_names()[:count]]


def _pair(folder: Path) -> Pair:
    disparity, least = read_disparity(folder)
    known = disparity > 0
    depth = MIDDLEBURY_FOCAL_PX * MIDDLEBURY_BASELINE_M / (filled(disparity, known, near_is_high=True) + least)
    if folder.name == "Bowling1":
        hole = binary_dilation(binary_erosion(~known, _disk(3)), _disk(20)) & ~known
        depth = np.where(hole, PADLESS_M, depth)
    luma = _shrunk(read_luma(folder, (len(disparity), disparity.shape[1])))
    return Pair(folder.name, _shrunk(depth), np.clip(luma, 0, None))


def _disk(radius: int) -> np.ndarray:
    across = np.arange(-radius, radius + 1)
    return across[:, None] ** 2 + across**2 <= radius**2


def _shrunk(image: np.ndarray) -> np.ndarray:
    """Edges repeated to a multiple of PAD_TO on both sides, then SHRINK times smaller by an antialiased cubic."""
    missing = [-side % PAD_TO for side in image.shape]
    padded = np.pad(image, [(m // 2, m - m // 2) for m in missing], mode="edge")
    size = (padded.shape[1] // SHRINK, padded.shape[0] // SHRINK)
    return np.asarray(Image.fromarray(padded.astype(np.float32)).resize(size, Image.Resampling.BICUBIC), np.float64)


def errors_of(
    store: Store,
    subjects: Sequence[EvaluatedModel],
    photographs: Sequence[Pair],
    levels: Sequence[tuple[float, float]],
    offset_m: float,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, object]]:
    """Return a row of every model, pair and level: MAE and RMSE [mm] against the published label and against the
    arrival.

    The published label is the pulse's fullest bin, from 0; a depth of ours, centred on bins, is taken half a bin less
    against it. `arrival` is the centroid of the published pulse, which lies before that bin: what our models were
    trained to find. Both in the published speed of light.
    """
    report, rows = progress or (lambda what, fraction: None), []
    for number, pair in enumerate(photographs):
        for level in levels:
            report(f"{pair.name}, {level[0]:g} + {level[1]:g}, {offset_m:g} m", number / len(photographs))
            key = {"pair": pair.digest, "level": list(level), "offset_m": offset_m, "seed": seed}
            missing = [one for one in subjects if store.get(one.digest, **key) is None]
            if missing:
                histogram = sensed_pair(pair, level, offset_m, (seed, number, PHOTON_LEVELS.index(level)))
                for one in missing:
                    store.put(one.digest, errors_as_published(one.model, histogram, "soft-argmax"), **key)
            for one in subjects:
                common = {"model": one.name, "pair": pair.name, "offset_m": offset_m}
                rows.append({**common, "signal": level[0], "background": level[1], **store.get(one.digest, **key)})
    return rows


def sensed_pair(pair: Pair, level: tuple[float, float], offset_m: float, key: tuple[int, ...]) -> Histogram:
    """Sense a pair in the published simulation, `offset_m` farther away; `key` is the seed of its photons."""
    budget, sensor = PhotonBudget(*level), Sensor()
    expected = published_from_rgbd(pair.depth_m + offset_m, pair.luma, pair.luma, sensor, budget)
    rng = np.random.default_rng(np.random.SeedSequence(key, spawn_key=(Stream.PUBLISHED,)))
    return Histogram(
        rng.poisson(expected.rates).astype(np.int32),
        sensor,
        budget,
        expected.depth_m.astype(np.float32),
        np.zeros(pair.luma.shape, bool),
        pair.luma.astype(np.float16),
        expected.signal.astype(np.float32),
        expected.background.astype(np.float32),
    )


def errors_as_published(model: DepthEstimator, histogram: Histogram, decoder: Decoder) -> dict[str, float]:
    """Compare a model with the published label and with the pulse's arrival, as `depth_errors_as_published` does."""
    depth, _ = model.depth_of(histogram, decoder=decoder)
    return depth_errors_as_published(depth, histogram)


def depth_errors_as_published(depth_m: np.ndarray, histogram: Histogram) -> dict[str, float]:
    """Compare a depth map with the published label and with the pulse's arrival: MAE, RMSE [mm], share within 10 mm.

    Models of the published grid know the label alone: their columns of the arrival mean nothing.
    """
    sensor = histogram.sensor
    bins = depth_m.astype(np.float64) / sensor.bin_depth_m
    step_m = PUBLISHED_SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s / 2
    early = published_centroid_bins(sensor)  # in bins after the fullest
    found: dict[str, float] = {}
    for name, estimate in (("label", bins - 0.5), ("arrival", bins - 0.5 - early)):
        # what is sure of the first bin is half a bin deep but for rounding, and no depth is below 0
        errors = image_errors(np.maximum(estimate, 0) * step_m, histogram.depth_m, range_m=np.inf)
        found |= {f"{figure}_{name}": errors[figure] for figure in ("mae_mm", "rmse_mm", "within_10mm")}
    return found


def evaluate_as_published(
    models: Mapping[str, DepthModel],
    unfinished: Unfinished,
    *,
    seed: int = 0,
    offset_m: float = 0.0,
    progress: Progress,
) -> list[dict[str, object]]:
    """Evaluate models on the paper's pairs in its own simulation, a row a model, pair, level and decoder.

    `reference` is what a model is compared with: the published label for models of the published grid, the pulse's
    arrival for ours, whose labels are centred on the pulse. `unfinished` keeps estimates until the caller ends it.
    Raises InputError where no pair is found.
    """
    photographs, rows = pairs(), []
    ways = [(name, decoder) for name in models for decoder in DECODERS]
    methods = {(name, decoder): unfinished.method(models[name], [], decoder=decoder) for name, decoder in ways}
    for number, pair in enumerate(photographs):
        for place, level in enumerate(PHOTON_LEVELS):
            progress(f"{pair.name}, {level[0]:g} + {level[1]:g}", number / len(photographs))
            histogram = sensed_pair(pair, level, offset_m, (seed, number, place))
            for (name, decoder), method in methods.items():
                reference = "label" if models[name].config.grid == "published" else "arrival"
                errors = depth_errors_as_published(method(histogram), histogram)
                common = {"model": name, "pair": pair.name, "signal": level[0], "background": level[1]}
                common |= {"decoder": decoder, "reference": reference}
                kept = {figure: errors[f"{figure}_{reference}"] for figure in ("mae_mm", "rmse_mm", "within_10mm")}
                rows.append({**common, **kept, "mae_mm_label": errors["mae_mm_label"]})
    return rows


def run_evaluate(command: Evaluate, progress: Progress) -> dict:
    """Return networks on the paper's pairs in its own simulation, by both decoders: a table (.csv), and the means."""
    named = {str(path): load_model(checkpoint_of(path))[0] for path in command.checkpoints}
    require(bool(named), "evaluate: give at least one checkpoint")
    require(not command.levels, "evaluate: --levels does not go with --set published, whose 16 levels are the paper's")
    given = {
        "--decoder": command.decoder,
        "--law": command.law,
        "--maps": command.maps,
        "--tiled": command.tiled,
        "--views": command.views,
        "--int8": command.int8,
        "--int8-rule": command.int8_rule,
    }
    for option, value in given.items():
        require(value in (None, False), f"evaluate: {option} does not go with --set published")
    kept = not command.baselines or command.baselines == Evaluate.baselines
    require(kept, "evaluate: --baselines does not go with --set published, which is of networks alone")
    for name, model in named.items():
        warn_of_unfinished(name)
        model.config.sensor.check_offset(command.offset)
    unfinished = Unfinished(command.out / "unfinished")
    rows = evaluate_as_published(named, unfinished, seed=command.seed, offset_m=command.offset, progress=progress)
    unfinished.say()
    command.out.mkdir(parents=True, exist_ok=True)
    table = write_csv(rows, command.out / "evaluation-published.csv")
    unfinished.end()
    return {"means": format_published(rows), "csv": str(table)} | ({"rows": rows} if command.json else {})


def format_published(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Say the means over pairs and levels of `evaluate_as_published`, a line a model and decoder."""
    lines = []
    for name, decoder in dict.fromkeys((row["model"], row["decoder"]) for row in rows):
        mine = [row for row in rows if (row["model"], row["decoder"]) == (name, decoder)]
        means = {figure: float(np.mean([row[figure] for row in mine])) for figure in ("mae_mm", "rmse_mm")}
        lines.append(
            f"{name}, {decoder}: MAE {means['mae_mm']:.2f} mm, RMSE {means['rmse_mm']:.2f} mm against the "
            f"{mine[0]['reference']}"
        )
    return lines


def available(count: int | None) -> tuple[list[Pair], str]:
    """Return the pairs, and why there are none."""
    try:
        return pairs(count), ""
    except InputError as error:
        return [], str(error)


def beside_ours(rows: Sequence[dict], wanted: Sequence[ModelSpec], offsets_m: Sequence[float]) -> list[dict]:
    """Return our models on the photographs beside what was published, near and far [mm]; `of`: how much of the test
    set."""
    found = []
    scenes, levels = len({row["pair"] for row in rows}), len({(row["signal"], row["background"]) for row in rows})
    for one in wanted:
        line: dict[str, object] = {"model": one.name, "of": f"{scenes} of {SCENES} scenes, {levels} of 16 levels"}
        for place, moved in zip(("near", "far"), offsets_m, strict=False):
            mine = [row for row in rows if row["model"] == one.name and row["offset_m"] == moved]
            for figure in ("mae_mm_label", "mae_mm_arrival", "rmse_mm_label"):
                values = [row[figure] for row in mine]
                line[f"{place}_{figure}"] = float(np.mean(values)) if values else math.nan
            line[f"{place}_published_mae_mm"] = getattr(printed(one), f"{place}_mae", None)
            line[f"{place}_published_rmse_mm"] = getattr(printed(one), f"{place}_rmse", None)
        found.append(line)
    return found


def compared(
    store: Store,
    models: Mapping[ModelSpec, EvaluatedModel],
    count: int | None,
    levels: Sequence[tuple[float, float]],
    offsets_m: Sequence[float],
    *,
    seed: int,
    progress: Progress,
) -> list[dict]:
    """Return `beside_ours` of models on the pairs found, at most `count`; empty, and said so, where there are none."""
    photographs, missing = available(count)
    if missing:
        log.warning("the published convention is left out: %s", missing)
        return []
    rows = []
    for moved in offsets_m:
        rows += errors_of(store, [*models.values()], photographs, levels, moved, seed=seed, progress=progress)
    return beside_ours(rows, [*models], offsets_m)
