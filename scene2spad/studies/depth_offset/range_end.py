"""The end of the range in `study depth-offset`: do codes, back-projection or network fail there?

The same photons meet the network with one thing changed at a time: its input as the near scene gives it but at the far
place, as the far scene gives it but at the near place, or without the removal of the mean over K, which alone of all
steps is not the same at every delay; and the codes are decoded without a network. A wall at one depth after another
shows bias beside error.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from csph import CodingTensor, decode_depth, encode
from csph.codes import blocks
from csph.evaluation.methods import Row
from csph.layer import CompressiveLayer
from csph.networks.model import DepthModel
from csph.networks.posterior import Decoder
from scene2spad.datasets.planes import wall
from scene2spad.networks.registry import EvaluatedModel, ModelSpec, Trained
from scene2spad.networks.results import Store
from scene2spad.studies.depth_offset.tables import by_design, mean_error
from scenes.json_types import JsonObject
from spad.detection.detect import sense
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

WALL_PIXELS = 32  # on a side
# What is changed between photons and depth: the key of a result, and what it says.
AS_TRAINED = "as trained"
ARMS: dict[str, str] = {
    AS_TRAINED: "the model as it is",
    "near input, far place": "back-projection of the counts moved back, then moved to where they were",
    "far input, near place": "back-projection of the counts as they are, moved back before the network",
    "mean kept": "back-projection without removal of the mean over K",
    "correlation": "the codes decoded by correlation over K, pixel by pixel, without a network",
}
DELAY_FREE = ("mean kept", "correlation")  # those that are the same whatever the delay


class NearInput(nn.Module):
    """A layer that sees counts `bins` earlier; its back-projection is moved to where the counts were."""

    def __init__(self, layer: nn.Module, bins: int) -> None:
        super().__init__()
        self.layer, self.bins = layer, bins

    def forward(self, counts: Tensor) -> Tensor:
        return self.layer(counts.roll(-self.bins, 2)).roll(self.bins, 2)


class NearPlace(nn.Module):
    """A network that sees its input `bins` earlier; its answer is moved back."""

    def __init__(self, network: nn.Module, bins: int) -> None:
        super().__init__()
        self.network, self.bins = network, bins
        self.coarsest, self.reach = network.coarsest, network.reach  # what cuts images into tiles asks for them

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x.roll(-self.bins, 2)).roll(self.bins, 1)


class MeanKept(nn.Module):
    """A layer whose back-projection is the cosine over K between codes: Fourier codes give the same at every delay."""

    def __init__(self, layer: CompressiveLayer) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, counts: Tensor) -> Tensor:
        unit = blocks.zero_normalised(self.layer.encode(counts), 1, centre=False)
        return blocks.back_project(unit, blocks.zero_normalised(self.layer.weights(), 0, centre=False))


class Correlated:
    """Depth from the codes of each pixel by correlation over K."""

    def __init__(self, coding: CodingTensor) -> None:
        self.coding = coding

    def depth_of(self, histogram: Histogram, *, decoder: Decoder | None = None) -> tuple[np.ndarray, int]:
        codes = encode(torch.from_numpy(histogram.counts), self.coding)
        return decode_depth(codes, self.coding, histogram.sensor).numpy(), 0


def arm(trained: Trained, name: str, offset_m: float = 0.0) -> EvaluatedModel:
    """Return the model with one thing changed, by its key in ARMS; `offset_m` is how far inputs are moved back."""
    bins = round(offset_m / trained.config.model.sensor.bin_depth_m)
    if name not in ARMS or name == AS_TRAINED:
        return trained.subject
    codes = trained.model.codes_layer
    layer: nn.Module = codes
    network: nn.Module = trained.model.network
    if name == "correlation":
        return EvaluatedModel(f"{trained.wanted.name}, {name}", Correlated(codes.coding()), _digest(trained, name))
    if name == "near input, far place":
        layer, name = NearInput(layer, bins), f"{name} {bins}"
    elif name == "far input, near place":
        network, name = NearPlace(trained.model.network, bins), f"{name} {bins}"
    else:
        layer = MeanKept(codes)
    model = DepthModel(trained.config.model)
    model.add_module("layer", layer)
    model.add_module("network", network)
    return EvaluatedModel(f"{trained.wanted.name}, {name}", model.eval(), _digest(trained, name))


def _digest(trained: Trained, how: str) -> str:
    return hashlib.sha256(f"{trained.subject.digest} {how}".encode()).hexdigest()


def arm_rows(errors: Mapping[tuple[str, float], Sequence[float]]) -> list[JsonObject]:
    """Return a row an arm and offset from the MAE [mm] of every seed: mean, least and largest."""
    return [{"arm": name, "offset_m": metres, **_over_seeds(values)} for (name, metres), values in errors.items()]


def seed_rows(rows: Mapping[float, Sequence[Row]], wanted: Iterable[ModelSpec]) -> list[JsonObject]:
    """Return a row a design and offset: MAE [mm] over its seeds, from rows by offset."""
    designs = by_design(wanted)
    return [
        {"design": label, "compression": ratio, "offset_m": metres}
        | _over_seeds([mean_error(some, one.name) for one in members])
        for (label, ratio), members in designs.items()
        for metres, some in rows.items()
    ]


def _over_seeds(values: Sequence[float]) -> JsonObject:
    """Mean of the seeds, and the least and the largest of them: an interval of so few is no more."""
    spread = {"mae_mm": float(np.mean(values)), "least_mm": float(min(values)), "largest_mm": float(max(values))}
    return {**spread, "every_seed_mm": [float(value) for value in values]}


def wall_errors(
    store: Store, subject: EvaluatedModel, depths_m: Sequence[float], level: tuple[float, float], seed: int
) -> list[dict[str, float]]:
    """Return bias and MAE [mm] of a model before a wall at each depth, every pixel equally far; kept in the store."""
    found = []
    for number, depth_m in enumerate(depths_m):
        key = {"wall_m": float(depth_m), "signal": level[0], "background": level[1], "seed": seed}
        kept = store.get(subject.digest, **key)
        if kept is None:
            draw = 1000 * seed + number
            drawn = sense(wall(depth_m, WALL_PIXELS), Sensor(), PhotonBudget(*level), seed=draw, model="poisson")
            errors = 1e3 * (subject.model.depth_of(drawn)[0].astype(np.float64) - depth_m)
            kept = {"bias_mm": float(np.nanmean(errors)), "mae_mm": float(np.nanmean(np.abs(errors)))}
            store.put(subject.digest, kept, **key)
        found.append({"depth_m": float(depth_m), **kept})
    return found


def observation(arms: Sequence[JsonObject], factor: float) -> list[str]:
    """Say of every arm how far its largest error lies over that at no offset; `factor` times is called a failure."""
    lines = []
    for name in dict.fromkeys(row["arm"] for row in arms):
        mine = [row for row in arms if row["arm"] == name]
        near, worst = mine[0], max(mine, key=lambda row: row["mae_mm"])
        verdict = "fails" if worst["mae_mm"] > factor * near["mae_mm"] else "holds to the end of the range"
        lines.append(
            f"{name} ({ARMS[name]}): {near['mae_mm']:,.0f} mm as it is, at most {worst['mae_mm']:,.0f} mm "
            f"({worst['least_mm']:,.0f} to {worst['largest_mm']:,.0f} by seed) at +{worst['offset_m']:g} m: {verdict}"
        )
    return lines
