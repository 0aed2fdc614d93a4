"""`DepthModel`: counts -> codes -> back-projection -> network -> depth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from csph.codes.blocks import check_counts, encode_blocks
from csph.codes.design import OWN
from csph.codes.quantise import INT8_RULES, Int8Rule, encode_int16, published_int8, wrapped_sums
from csph.codes.tensor import CodingTensor
from csph.layer import CompressiveLayer
from csph.networks.blockwise import Blockwise, mixers_for
from csph.networks.choice import network_of, own_network
from csph.networks.config import ModelConfig, grows
from csph.networks.grid import published_position
from csph.networks.images import TILE, WHOLE_PIXELS, Span, sees_photons, spans
from csph.networks.posterior import Decoder, confidence, decoded
from csph.networks.published import parameters_of
from csph.networks.refined import Refined
from scenes.errors import InputError, require, require_kind, require_whole
from spad.estimators.bistatic import radial_depth_of
from spad.estimators.matching import normalised_correlation
from spad.measurements.histogram import Histogram


class Estimate(NamedTuple):
    """Depth estimate of an image by a network.

    depth_m      (H, W) float32 [m]
    confidence   (H, W) float32: share of the posterior within 3 bins of the answer; 0 where the network sees no photon
    overflows    16-bit sums that wrapped: of codes in 8 bits, and of a layer that was trained with `int8`
    """

    depth_m: np.ndarray
    confidence: np.ndarray
    overflows: int


def _inside(span: Span) -> slice:
    """Return the part of what a tile reads that is its own."""
    return slice(span.inner, span.inner + span.own.stop - span.own.start)


class DepthModel(nn.Module):
    """Counts (B, 1, T, R, C) -> logits (B, T, R, C); `seed` decides where weights begin.

    `load_model` has an example.

    own       the codes of a design of own codes (`csph.codes.files.own_codes`)
    network   (B, 1, T, R, C) -> logits (B, T, R, C), in place of the one that the configuration names: a module whose
              `reach` is how many pixels around one its answer depends on, and `coarsest` the side in pixels of the
              cells that its layers pool. `save_model` knows no such network

    An empty batch has empty logits. Raises InputError for parts of another kind, and a network without these numbers.
    """

    def __init__(
        self,
        config: ModelConfig,
        seed: int = 0,
        *,
        own: CodingTensor | None = None,
        network: nn.Module | None = None,
    ) -> None:
        super().__init__()
        require_kind(config, ModelConfig, "DepthModel")
        seed = require_whole(seed, "DepthModel: seed")
        self.config = config
        self.layer: CompressiveLayer | None = None
        if config.design is not None:
            start = config.spatial_start
            self.layer = CompressiveLayer.of(
                config.design, sensor=config.sensor, seed=seed, spatial_start=start, own=own, **config.layer
            )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = network_of(config) if network is None else own_network(network)
        self.has_own_network = network is not None

    def begin_with(self, other: DepthModel) -> None:
        """Take the weights of a model of the same design, or of one that this design `holds`, and its network; clipping
        ranges of int8 that it has not are fitted to them."""
        mine, theirs = self.layer, other.layer
        fits = mine is not None and theirs is not None and mine.options.int8 and not theirs.options.int8
        self.begin_with_network(other)
        if mine is not None and theirs is not None and self.config.design != other.config.design:
            mine.begin_within(theirs.raw_coding(), self.config.codes_design)
            mine.take_ranges(theirs)
            return
        weights = {name: value for name, value in other.state_dict().items() if not name.startswith("network.")}
        own = {name: value for name, value in self.state_dict().items() if name.startswith("network.")}
        self.load_state_dict({**weights, **own}, strict=not fits)
        if mine is not None and fits:
            mine.fit_ranges()

    def begin_with_network(self, other: DepthModel) -> None:
        """Take the weights of another model's network alone.

        What a larger network has beyond a smaller one (`networks.config.HELD`) keeps its start, which adds nothing;
        so do the steps that mix a block's pixels where blocks differ in pixels. Where they differ in bins, these are
        repeated along time.
        """
        grown = self.config.network != other.config.network and grows(other.config.network, self.config.network)
        theirs = other.network.state_dict()
        if self.config.sees_codes and other.config.sees_codes:
            same = self.config.block[1:] == other.config.block[1:]
            theirs = mixers_for(self.network.state_dict(), theirs, same_pixels=same)
        self.network.load_state_dict(theirs, strict=not grown)

    @property
    def codes_layer(self) -> CompressiveLayer:
        """The layer that makes the codes. Raises InputError for a network without codes."""
        if self.layer is None:
            raise InputError(f"{self.config.name}: has no codes, its network sees all bins")
        return self.layer

    @property
    def own_codes(self) -> CodingTensor | None:
        """The codes of a design of own codes, which another model of the design needs; None of other designs."""
        own = self.config.design is not None and self.config.design.code == OWN
        return self.codes_layer.raw_coding() if own else None

    @property
    def parameters_count(self) -> int:
        """Count the numbers that training changes."""
        return parameters_of(self)

    def network_input(self, counts: Tensor) -> Tensor:
        """Return what the network sees, (B, 1, T, R, C): back-projection, counts, these matched, or 1 at the fullest
        bin."""
        if self.layer is not None:
            return self.layer(counts)
        require_kind(counts, Tensor, "counts", " (`torch.from_numpy` makes one)")
        if self.config.front == "counts" or not len(counts):
            return counts.float()
        if self.config.front == "matched":
            return normalised_correlation(counts.float().flatten(3).squeeze(1), self.config.sensor).view(counts.shape)
        return torch.zeros(counts.shape, device=counts.device).scatter_(2, counts.argmax(2, keepdim=True), 1.0)

    def windowed(self, counts: Tensor, first_bin: Tensor, window: int) -> Tensor:
        """Return logits (B, window, R, C) of the bins from `first_bin` (B,) on, whose blocks alone are encoded."""
        whole = counts if self.layer is not None else self.network_input(counts)
        firsts = first_bin.tolist()
        cut = torch.stack([one[:, first : first + window] for one, first in zip(whole, firsts, strict=True)])
        return self(cut) if self.layer is not None else self._logits(cut)

    def logits_of_codes(self, codes: Tensor) -> Tensor:
        """Return logits (B, T, R, C) of codes (B, K, T/Mt, R/Mr, C/Mc)."""
        x = self.codes_layer.decode(codes)
        if isinstance(self.network, Refined):
            return self._logits(x, codes.to(x.dtype), self.codes_layer)
        return self._logits(x, codes.to(x.dtype)) if isinstance(self.network, Blockwise) else self._logits(x)

    def _logits(self, x: Tensor, *codes: object) -> Tensor:
        """Compute logits (B, T, R, C) from what the network sees, (B, 1, T, R, C), in the type of its weights."""
        x = x.to(next(self.network.parameters()).dtype)
        if len(x):
            return self.network(x, *codes)
        check_counts(x, (1, 1, 1))
        return x.squeeze(1)

    def forward(self, counts: Tensor) -> Tensor:
        """Return logits (B, T, R, C) of counts (B, 1, T, R, C) that blocks tile."""
        if self.config.sees_codes and self.layer is not None:
            return self.logits_of_codes(self.layer.encode(counts))
        return self._logits(self.network_input(counts))

    def position(self, logits: Tensor, decoder: Decoder | None = None) -> Tensor:
        """Return the answer in bins from the edge of bin 0, (B, T, R, C) -> (B, R, C); decoder None: the
        configuration's."""
        return self._on_grid(decoded(logits, decoder or self.config.decoder))

    def _on_grid(self, bins: Tensor) -> Tensor:
        return bins if self.config.grid == "continuous" else published_position(bins, self.config.sensor.bins)

    def depth_m(self, counts: Tensor, decoder: Decoder | None = None) -> Tensor:
        """Return depth of counts (B, 1, T, R, C) that blocks tile, (B, R, C) [m]; decoder as in `position`."""
        return self.position(self(counts), decoder) * self.config.sensor.bin_depth_m

    def depth_of_codes(self, codes: Tensor, decoder: Decoder | None = None) -> Tensor:
        """Return depth (B, R, C) [m] from codes (B, K, T/Mt, R/Mr, C/Mc) that a sensor has made; decoder as in
        `position`.

        Raises InputError for a model without codes, and codes of another shape.
        """
        if self.layer is None:
            raise InputError(f"{self.config.name}: has no codes to find depth from")
        logits = self.logits_of_codes(codes)
        return self.position(logits, decoder) * self.config.sensor.bin_depth_m

    def check_histogram(self, histogram: Histogram) -> None:
        """Raise InputError unless the histogram is of the sensor that the model was trained for."""
        require_kind(histogram, Histogram, "DepthModel", " of `sense`, `read_histogram` or `read_mat`")
        sensors = self.config.sensor, histogram.sensor
        mine, other = ((s.bins, s.bins_per_period, s.bin_width_s, s.response) for s in sensors)
        words = (f"{s.name} ({s.bins} of {s.bins_per_period} bins of {s.bin_width_s * 1e12:.4g} ps)" for s in sensors)
        require(mine == other, f"the network was trained for another sensor or pulse: {', not for '.join(words)}")

    def _tiles(self, rows: int, columns: int, tile: int | None) -> Iterator[tuple[Span, Span]]:
        _, height, width = self.config.block
        units = (math.lcm(side, self.network.coarsest) for side in (height, width))
        axes = zip((rows, columns), (height, width), units, strict=True)
        down, across = (spans(*axis, self.network.reach, tile) for axis in axes)
        return iter(product(down, across))

    @torch.no_grad()
    def estimate(
        self,
        histogram: Histogram,
        *,
        int8: bool = False,
        int8_rule: Int8Rule = "calibrated",
        decoder: Decoder | None = None,
        tile: int | None = None,
    ) -> Estimate:
        """Estimate radial depth and confidence of a histogram of any size; decoder as in `position`.

        With a displaced laser the network's half path becomes a distance by the histogram's geometry.

        What blocks do not tile is reflected at the end; images over `WHOLE_PIXELS` go through in tiles of `tile` pixels
        (default: `TILE`; smaller images in tiles only if it is given) whose halo holds all that the network sees.
        `int8`: codes of 8-bit weights summed in 16 bits (`csph.codes.quantise.quantised`), or with the rule
        "published" of weights rounded to 8 bits and summed in float32 (`published_int8`); the decoder keeps float32.
        Raises InputError for another sensor's histogram, and for tiles of no pixel.
        """
        whole = tile is None or (isinstance(tile, int) and tile >= 1)
        require(whole, f"tiles of {tile!r} pixels, expected a whole number of 1 or more")
        require(int8_rule in INT8_RULES, f"8-bit rule {int8_rule!r} is unknown, expected {' or '.join(INT8_RULES)}")
        self.check_histogram(histogram)
        rows, columns, bins = histogram.counts.shape
        tile = tile or (TILE if rows * columns > WHOLE_PIXELS else None)
        circular = self.config.network == "periodic"
        depth, sure, overflows = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32), 0
        for down, across in self._tiles(rows, columns, tile):
            part = histogram.counts
            if len(down.read) != rows or len(across.read) != columns:
                part = part[down.read[:, None], across.read]
            # a transposed matrix of pixels x bins: torch copies it in a third of the time of permuted axes
            size = (1, 1, bins, len(down.read), len(across.read))
            counts = torch.from_numpy(part).reshape(-1, bins).T.contiguous().view(size)
            inside = _inside(down), _inside(across)
            if int8:
                logits, wrapped = self._logits_int8(counts, inside, int8_rule)
            else:
                counts = counts.to(next(self.parameters()).device).float()
                logits, wrapped = self(counts), self._trained_overflows(counts, inside)
            overflows += wrapped
            logits = logits[..., inside[0], inside[1]]
            place = decoded(logits, decoder or self.config.decoder)
            sure[down.own, across.own] = confidence(logits, place, circular=circular)[0].cpu()
            depth[down.own, across.own] = (self._on_grid(place) * self.config.sensor.bin_depth_m)[0].cpu()
        seen = sees_photons(histogram.counts, self.network.reach, self.config.block)
        return Estimate(radial_depth_of(histogram, depth), sure * seen, overflows)

    def _logits_int8(self, counts: Tensor, inside: tuple[slice, slice], rule: Int8Rule) -> tuple[Tensor, int]:
        """Compute logits from codes of 8-bit weights, and how many sums wrapped of the blocks that reach `inside`."""
        if self.layer is None:
            raise InputError(f"{self.config.name}: has no codes to hold in 8 bits")
        coding = self.layer.coding()
        if rule == "published":
            weights = published_int8(coding).tensor.to(self.layer.temporal.device)
            return self.logits_of_codes(encode_blocks(counts.to(weights.device), weights)), 0
        tensor = self.layer.quantised()
        codes, _ = encode_int16(counts, tensor)
        logits = self.logits_of_codes(codes.to(self.layer.temporal.device).float() * tensor.scale)
        return logits, encode_int16(self._whole_blocks(counts, inside), tensor).overflows

    def _whole_blocks(self, counts: Tensor, inside: tuple[slice, slice]) -> Tensor:
        """Return the counts of the blocks that reach `inside`."""
        rows, columns = (
            slice(one.start, -(-one.stop // side) * side)
            for one, side in zip(inside, self.config.block[1:], strict=True)
        )
        return counts[..., rows, columns]

    def _trained_overflows(self, counts: Tensor, inside: tuple[slice, slice]) -> int:
        """Count sums that wrap in the cores of a layer with `int8`, of the blocks that reach `inside`; 0 of others."""
        # studies put other modules in the layer's place
        if not isinstance(self.layer, CompressiveLayer) or not self.layer.options.int8:
            return 0
        sums, _ = self.layer.core_sums(self._whole_blocks(counts, inside))
        return int((wrapped_sums(sums) != sums).sum())

    def depth_of(
        self,
        histogram: Histogram,
        *,
        int8: bool = False,
        int8_rule: Int8Rule = "calibrated",
        decoder: Decoder | None = None,
    ) -> tuple[np.ndarray, int]:
        """Return depth map (H, W) float32 [m] of `estimate`, and how many 16-bit sums wrapped.

        Raises InputError as `estimate`.
        """
        found = self.estimate(histogram, int8=int8, int8_rule=int8_rule, decoder=decoder)
        return found.depth_m, found.overflows
