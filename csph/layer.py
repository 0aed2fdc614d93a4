"""The compressive-histogram layer: encoder, and the unfiltered back-projection with the same weights.

    y = C~ n in every block           C~ = C - mean of C over its own time axis
    x = ZN(C~)^T ZN(y)                ZN(v) = (v - mean_K v) / (|v - mean_K v|_2 + 1e-5), over the K codes

so that x is Pearson's correlation over K between the codes kept and those that a lone detection leaves (supplement
S.5.2; a convolution and a transposed convolution with stride = kernel there, matrix products over blocks here).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from csph.codes import blocks, rank
from csph.codes.design import OWN, Design
from csph.codes.nested import nested
from csph.codes.photons import encode_photons, photon_table
from csph.codes.quantise import (
    HALF_RANGE,
    Quantised,
    clipped_steps,
    from_factors,
    quantised,
    straight_through,
    wrapped_sums,
)
from csph.codes.temporal import circle_of, orthogonal_start, spatial_seed, temporal_code, uniform_start
from csph.codes.tensor import CodingTensor, as_tensor, full_tensor
from csph.layer_options import STARTS, LayerOptions, SpatialStart, check_switches
from scenes.errors import require, require_choice, require_kind, require_whole
from spad.sensor.model import Sensor
from spad.sensor.template import binned_pulse


def make_coding(
    design: Design, sensor: Sensor | None = None, seed: int = 0, spatial_start: SpatialStart = "uniform"
) -> CodingTensor:
    """Return the coding tensor that a design begins with: fixed codes, and learned parts uniform in +-1/sqrt(n), n the
    entries of one code of that part; a spatial part may begin orthogonal instead, with the same mean square. `sensor`
    (default: the reference) lends its pulse to Gray Fourier. `Design` has an example.

    Raises InputError where K does not fit the code, for own codes, which are in a file, and for what is no Design.
    """
    require_kind(design, Design, "make_coding")
    require(design.code != OWN, f"{design.name}: its codes are in a file, which `csph.codes.files.own_codes` reads")
    require_kind(sensor or Sensor(), Sensor, "make_coding: sensor")
    require_choice(spatial_start, STARTS, "spatial_start")
    seed = require_whole(seed, "make_coding: seed")
    (bins, rows, columns), codes = design.block, design.codes
    if design.full:
        return CodingTensor(design.name, uniform_start((codes, bins, rows, columns), design.size, seed))
    if design.code in ("learned", "random"):
        temporal = uniform_start((codes, bins), bins, seed)
    else:
        temporal = temporal_code(design.code, codes, bins, sensor or Sensor())
    start = orthogonal_start if spatial_start == "orthogonal" else uniform_start
    spatial = start((codes, rows, columns), rows * columns, spatial_seed(seed)) if design.has_spatial else None
    return CodingTensor(design.name, temporal, spatial, computed=design.computed)


def _own_coding(coding: CodingTensor, design: Design) -> CodingTensor:
    """Return own codes. Raises InputError unless they are those of a design of own codes."""
    require_kind(coding, CodingTensor, "own codes")
    require(design.code == OWN, f"{design.name}: own codes {coding.name} are for a design of own codes")
    shape = (design.codes, *(design.block if design.full else design.block[:1]))
    found = tuple(coding.temporal.shape)
    require(found == shape and coding.spatial is None, f"{design.name}: own codes are {found}, expected {shape}")
    return coding


def _as_int8(steps: Tensor, step: Tensor) -> tuple[np.ndarray, float]:
    return steps.to(torch.int8).cpu().numpy(), float(step)


class CompressiveLayer(nn.Module):
    """Counts (B, 1, T, R, C) -> codes (B, K, T/Mt, R/Mr, C/Mc) -> (B, 1, T, R, C) in [-1, 1].

    coding      where the weights begin; its parts named in `learned` ("temporal", "spatial") are parameters, the others
                buffers, both under these names in `state_dict`
    sensor      whose pulse the pulse switches use (default: the reference)
    background  (T,) shape in time of a background that is not uniform (a gate, pile-up), any scale: the direction that
                it takes among the codes of each time block is projected out of codes and weights before normalisation

    With `int8` the logarithms of the clipping ranges are parameters as well, `temporal_range` and `spatial_range`; they
    begin at each factor's largest magnitude (`fit_ranges`).

    Sums and results are in float32 whatever the counts' type and autocast, in float64 where the weights are. Weights of
    16 bits (`bfloat16()`, `half()`) are taken to float32 first: only the weights themselves are rounded.

    `torch.func.functional_call` runs it with other weights, and `backward` and `torch.autograd.functional.jacobian`
    give its first derivatives. It has no batching rule and no second derivative: `vmap`, `grad` and `jacrev` of
    `torch.func` end in a RuntimeError, and `torch.autograd.functional.hessian` raises with `strict`, else gives zeros.

    Raises InputError for options and parts that do not go together, objects of another kind, and a background of
    another shape.

    Examples
    --------
    One detection is found where it is: its codes correlate by 1 with those that a detection there leaves.

    >>> import torch
    >>> import scene2spad as s2s
    >>> layer = s2s.CompressiveLayer.of(s2s.Design("learned", (16, 2, 2), 8))
    >>> counts = torch.zeros(1, 1, 32, 4, 4)  # (B, 1, T, R, C)
    >>> counts[0, 0, 20, 1, 3] = 1
    >>> tuple(layer.encode(counts).shape), round(layer(counts)[0, 0, 20, 1, 3].item(), 2)
    ((1, 8, 2, 2, 2), 1.0)
    """

    temporal: Tensor
    spatial: Tensor | None
    pulse: Tensor | None
    background: Tensor | None
    temporal_range: nn.Parameter | None
    spatial_range: nn.Parameter | None

    def __init__(
        self,
        coding: CodingTensor,
        *,
        learned: tuple[str, ...] = (),
        options: LayerOptions | None = None,
        sensor: Sensor | None = None,
        background: Tensor | None = None,
    ) -> None:
        super().__init__()
        require_kind(coding, CodingTensor, "CompressiveLayer", " (`CompressiveLayer.of` takes a Design)")
        parts = {"temporal": coding.temporal, "spatial": coding.spatial}
        named = f"CompressiveLayer: learned {learned!r}, expected names of parts, as in ('temporal',)"
        words = isinstance(learned, list | tuple) and all(isinstance(part, str) for part in learned)
        require(words, named)
        unknown = [name for name in learned if parts.get(name) is None]
        require(not unknown, f"coding tensor {coding.name} has no part {', '.join(unknown)} to learn")
        self.name, self.block, self.codes, self.computed = coding.name, coding.block, coding.codes, coding.computed
        self.options = LayerOptions() if options is None else options
        require_kind(self.options, LayerOptions, "CompressiveLayer: options")
        for name, part in parts.items():
            copied = None if part is None else part.clone()
            if copied is not None and name in learned:
                self.register_parameter(name, nn.Parameter(copied))
            else:
                self.register_buffer(name, copied)
        self.register_buffer("pulse", self._pulse(sensor or Sensor()), persistent=False)
        self.register_buffer("background", self._background(background), persistent=False)
        self.temporal_range = self.spatial_range = None
        if self.options.int8:
            full = coding.is_full and coding.block[1:] != (1, 1)
            require(not full, f"coding tensor {coding.name}: int8 is for a temporal and a spatial factor, this is full")
            self.temporal_range = nn.Parameter(torch.zeros(()))
            self.spatial_range = None if coding.spatial is None else nn.Parameter(torch.zeros(()))
            self.fit_ranges()

    @classmethod
    def of(
        cls,
        design: Design,
        *,
        sensor: Sensor | None = None,
        seed: int = 0,
        spatial_start: SpatialStart = "uniform",
        own: CodingTensor | None = None,
        **options: bool,
    ) -> CompressiveLayer:
        """Return the layer of a design at its start; `options` are switches of LayerOptions, `own` the codes of a
        design of own codes (`csph.codes.files.own_codes`). Raises InputError for switches that it has not, and own
        codes that are not the design's."""
        check_switches(options)
        coding = make_coding(design, sensor, seed, spatial_start) if own is None else _own_coding(own, design)
        switches = replace(LayerOptions(zero_mean=bool(design.zero_mean)), **options)
        return cls(coding, learned=design.learned, options=switches, sensor=sensor)

    def _pulse(self, sensor: Sensor) -> Tensor | None:
        """Compute h_i(tau) on a circle of Mt bins, (Mt, Mt) float32, tau at bin centres; None where nothing uses it."""
        if not (self.options.pulse_in_codes or self.options.pulse_in_decoder):
            return None
        circle = circle_of(self.block[0], sensor)
        arrival = (torch.arange(circle.bins, dtype=torch.float64) + 0.5) * circle.bin_width_s
        return binned_pulse(arrival, circle).T.float()

    def _background(self, shape: Tensor | None) -> Tensor | None:
        if shape is None:
            return None
        shape = as_tensor(shape)
        good = shape.ndim == 1 and bool(shape.isfinite().all()) and len(shape) % self.block[0] == 0
        message = f"background of shape {tuple(shape.shape)}: expected finite values over time, a multiple of"
        require(good and bool(shape.any()), f"{message} {self.block[0]} bins, not all zero")
        return (shape / shape.abs().max()).float()

    def _blurred(self, weights: Tensor) -> Tensor:
        """Compute sum_i C[k, i, ...] h_i(tau): the codes of a pulse that arrives at each bin centre."""
        assert self.pulse is not None
        flat = weights.reshape(*weights.shape[:2], -1)
        return (self.pulse.to(weights.dtype).T @ flat).view(weights.shape)

    def _constrained_temporal(self) -> Tensor:
        temporal = blocks.widened(self.temporal)
        return blocks.centred(temporal, 1) if self.options.zero_mean else temporal

    def _exact_temporal(self) -> Tensor:
        part = self._constrained_temporal()
        return self._blurred(part) if self.options.pulse_in_codes else part

    def _temporal_steps(self) -> tuple[Tensor, Tensor]:
        assert self.temporal_range is not None
        return clipped_steps(self._exact_temporal(), blocks.widened(self.temporal_range))

    def _spatial_steps(self) -> tuple[Tensor, Tensor]:
        assert self.spatial is not None and self.spatial_range is not None
        return clipped_steps(blocks.widened(self.spatial), blocks.widened(self.spatial_range))

    def _temporal_part(self) -> Tensor:
        if not self.options.int8:
            return self._exact_temporal()
        steps, step = self._temporal_steps()
        return steps * step

    def _spatial_part(self) -> Tensor | None:
        if self.spatial is None:
            return None
        if not self.options.int8:
            return blocks.widened(self.spatial)
        steps, step = self._spatial_steps()
        return steps * step

    @torch.no_grad()
    def fit_ranges(self) -> None:
        """Set the clipping ranges of `int8` to the largest magnitude of each factor as it is now."""
        assert self.temporal_range is not None
        self.temporal_range.copy_(self._exact_temporal().abs().max().clamp(min=1e-30).log())
        if self.spatial is not None and self.spatial_range is not None:
            self.spatial_range.copy_(self.spatial.abs().max().clamp(min=1e-30).log())

    @torch.no_grad()
    def take_ranges(self, other: CompressiveLayer) -> None:
        """Take the clipping ranges that another `int8` layer of the same codes, over smaller blocks, has learned."""
        for mine, theirs in ((self.temporal_range, other.temporal_range), (self.spatial_range, other.spatial_range)):
            if mine is not None and theirs is not None:
                mine.copy_(theirs)

    @torch.no_grad()
    def quantised(self) -> Quantised:
        """Return the weights in 8 bits: within the learned ranges of `int8`, else within their largest magnitudes."""
        if not self.options.int8:
            return quantised(self.coding())
        temporal = _as_int8(*self._temporal_steps())
        spatial = (None, 1.0) if self.spatial is None else _as_int8(*self._spatial_steps())
        return from_factors(self.name, temporal, spatial)

    def weights(self) -> Tensor:
        """Return (K, Mt, Mr, Mc) that counts are encoded with: the constraint and the pulse applied."""
        return full_tensor(self._temporal_part(), self._spatial_part())

    def coding(self) -> CodingTensor:
        """Return the weights as they are now, constraint and pulse applied; separable ones stay so."""
        steps = None
        if self.options.int8:
            of_spatial = 1.0 if self.spatial is None else float(self._spatial_steps()[1].detach())
            steps = float(self._temporal_steps()[1].detach()), of_spatial
        return CodingTensor(self.name, self._temporal_part(), self._spatial_part(), self.computed, steps)

    def raw_coding(self) -> CodingTensor:
        """Return the weights as they are now with the constraint alone, before the pulse and without steps."""
        return CodingTensor(self.name, self._constrained_temporal(), self.spatial, computed=self.computed)

    @torch.no_grad()
    def begin_within(self, coding: CodingTensor, design: Design) -> None:
        """Take the codes of a tensor over smaller blocks, or of a separable one: see `csph.codes.nested`."""
        start = nested(coding, design)
        self.temporal.copy_(start.temporal)
        if self.spatial is not None and start.spatial is not None:
            self.spatial.copy_(start.spatial)
        if self.options.int8:
            self.fit_ranges()

    def pixel_gram(self) -> Tensor:
        """Return inner products of the codes of each two pixels of a block, (Mr Mc, Mr Mc): see `csph.codes.rank`."""
        temporal, spatial = self._temporal_part(), self._spatial_part()
        return rank.pixel_gram(temporal) if spatial is None else rank.separable_gram(temporal, spatial)

    def _materialises_full_tensor(self, counts: int) -> bool:
        return self.spatial is None or blocks.materialises_full_tensor(self.codes, self.block, counts)

    def encode(self, counts: Tensor) -> Tensor:
        """Return codes (B, K, T/Mt, R/Mr, C/Mc) of counts (B, 1, T, R, C). Raises InputError for counts of another
        shape or type, or that blocks do not tile."""
        with blocks.in_full(counts):
            return self._encode_int8(counts) if self.options.int8 else self._encode_exactly(counts)

    def encode_mean(self, mean_counts: Tensor) -> Tensor:
        """Return the mean codes of mean counts (B, 1, T, R, C) of any scale: `encode`, but with `int8` no sum wraps.
        Raises InputError as `encode`."""
        with blocks.in_full(mean_counts):
            return self._encode_exactly(mean_counts)

    def _encode_exactly(self, counts: Tensor) -> Tensor:
        spatial = self._spatial_part()
        if spatial is not None and not self._materialises_full_tensor(counts.numel()):
            return blocks.encode_separable(counts, self._temporal_part(), spatial)
        return blocks.encode_blocks(counts, self.weights())

    def core_sums(self, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Return sums of int8 steps of each core, (B, K, T/Mt, R, C) exact below 2^24, and the value of a step."""
        blocks.check_counts(counts, self.block)
        steps, step = self._temporal_steps()
        return blocks.encode_blocks(counts, steps.view(*steps.shape[:2], 1, 1)), step

    def _encode_int8(self, counts: Tensor) -> Tensor:
        sums, step = self.core_sums(counts)
        # backward as if no sum wrapped: the slope of a wrapped sum has the wrong sign, and would narrow the clipping
        # range, so that still more sums wrap
        held = straight_through(sums * step, wrapped_sums(sums) * step)
        spatial = self._spatial_part()
        if spatial is None:
            return held
        (batch, codes, times, rows, columns), (_, down, right) = held.shape, self.block
        of_blocks = held.view(batch, codes, times, rows // down, down, columns // right, right)
        return (of_blocks * spatial[:, None, None, :, None, :]).sum((4, 6))

    def sum_excess(self, counts: Tensor) -> Tensor:
        """Return the mean excess () of all cores' sums over 16 bits, in units of half that range, of counts
        (B, 1, T, R, C) with `int8`; its gradient widens the clipping range."""
        with blocks.in_full(counts):
            sums, _ = self.core_sums(counts)
            return (sums.abs() / HALF_RANGE - 1).relu().mean()

    def encode_timestamps(self, timestamps: Tensor, offsets: Tensor, size: tuple[int, int, int]) -> Tensor:
        """Return the same codes from detections; size (T, R, C) of the histogram that is not built. See
        `encode_photons`. Raises InputError with `int8`, whose sums are each core's."""
        require(not self.options.int8, f"coding tensor {self.name}: int8 codes are made from histograms")
        with blocks.in_full(timestamps):
            return encode_photons(timestamps, offsets, photon_table(self.weights()), self.block, size, name=self.name)

    def decode(self, codes: Tensor) -> Tensor:
        """Return ZN(C~)^T ZN(y), (B, 1, T, R, C), of codes (B, K, T/Mt, R/Mr, C/Mc), or an InputError for others."""
        with blocks.in_full(codes):
            return self._projected(self._checked(codes))

    def back_project(self, codes: Tensor) -> Tensor:
        """Return ZN(C~)^T y, (B, 1, T, R, C): `decode` of codes whose scale counts, as that of a residual does. Raises
        InputError for codes of another shape."""
        with blocks.in_full(codes):
            return self._projected(self._checked(codes), normalise=False)

    def _checked(self, codes: Tensor) -> Tensor:
        good = codes.ndim == 5 and codes.shape[1] == self.codes
        require(good, f"codes of shape {tuple(codes.shape)}: expected (batch, {self.codes}, time, rows, columns)")
        return codes.to(blocks.widened(self.temporal).dtype)

    def forward(self, counts: Tensor) -> Tensor:
        """Return `decode(encode(counts))`, (B, 1, T, R, C), the input of the depth network. Raises as `encode`."""
        with blocks.in_full(counts):
            return self._projected(self.encode(counts))

    def _unit(self, codes: Tensor, normalise: bool) -> Tensor:
        """Return ZN(y), or y less its mean over K where ZN would take it."""
        centre = not self.options.keep_mean
        if normalise:
            return blocks.zero_normalised(codes, 1, centre=centre, over=(2,) if self.options.per_pixel_norm else ())
        return blocks.centred(codes, 1) if centre else codes

    def _projected(self, codes: Tensor, normalise: bool = True) -> Tensor:
        centre = not self.options.keep_mean
        counts = codes.numel() * math.prod(self.block) // self.codes
        if self.background is None and self.spatial is not None and not self._materialises_full_tensor(counts):
            temporal = self._temporal_part()
            if self.options.pulse_in_decoder:
                temporal = self._blurred(temporal)
            spatial = self._spatial_part()
            assert spatial is not None
            return blocks.correlate_separable(self._unit(codes, normalise), temporal, spatial, centre=centre)
        weights = self.weights()
        direction = None if self.background is None else self._direction(self.background, weights, codes.shape[2])
        if self.options.pulse_in_decoder:
            weights = self._blurred(weights)
        if direction is not None:
            along = direction.T[..., None, None]
            codes = codes - (codes * along).sum(1, keepdim=True) * along
            flat = weights.flatten(1)
            weights = (flat - direction.unsqueeze(-1) * (direction @ flat).unsqueeze(1)).view(-1, *weights.shape)
        unit = self._unit(codes, normalise)
        axis = 0 if direction is None else 1
        return blocks.back_project(unit, blocks.zero_normalised(weights, axis, centre=centre))

    def _direction(self, background: Tensor, weights: Tensor, times: int) -> Tensor:
        """Compute the (T/Mt, K) unit vectors along what the background leaves in the codes of each time block; 0 where
        nothing."""
        shape = background.to(weights.dtype).view(-1, self.block[0])
        require(len(shape) == times, f"background of {shape.numel()} bins, codes of {times * self.block[0]}")
        per_bin = weights.sum((2, 3))
        left = shape @ per_bin.T
        # what rounding leaves of codes that cancel this background is no direction
        resolved = left.abs() > 1e-5 * (shape.abs() @ per_bin.abs().T)
        left = torch.where(resolved, left, 0.0)
        return left / left.norm(dim=1, keepdim=True).clamp(min=torch.finfo(left.dtype).tiny)
