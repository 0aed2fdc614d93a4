"""Define the settings of a render and the plan that answers them. Imports neither Mitsuba nor torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from numbers import Integral, Real
from typing import Literal, get_args

import numpy as np

from scenes.constants import MAX_PHOTONS
from scenes.errors import InputError, normalise_fields, require_number
from scenes.json_types import JsonObject

MAX_BOUNCES = 63
# A plane under direct light, the least there is, takes 170 bytes a pixel (measured); its file holds four arrays a pixel
# of some 120 bytes each when it is written.
MIN_PIXEL_BYTES = 170 + 4 * 120
MAX_SAMPLES = 1 << 26
MIN_ERROR = 1e-4  # that can be asked for, and that a plan aims at by itself
# Independent batches of indirect light, whose spread is the error estimate. Low-discrepancy sets run within a batch:
# fewer batches mean longer sets and less noise.
BATCHES = 4
MIN_SPP = 16  # paths a pixel of the darkest block, since pilots are short; fewer are traced only where asked for
FILTERED_BATCHES = 2  # the same of filtered light, whose regions hold a set of sums for each
GRIDS = (2, 4, 8, 16)
MAX_GRID = 64  # that can be forced
MAX_AMBIENT_SPP = 1 << 12
# Indirect returns of one pixel merge within so many metres of path, and this share of the path behind the direct light.
WIDEST_INDIRECT_M, WIDEST_GROWTH = 0.03, 0.05
FILTERED_AMBIENT_SPP = 2  # paths a pixel of ambient light where neighbours share it: as little noise as 45 alone

WHOLE = ("bounces", "spp", "grid", "min_spp", "ambient_spp")  # settings that are whole numbers

Refraction = Literal["straight", "bent"]


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a render, as the user asks for them; None leaves a choice to the plan.

    bounces     surfaces that light may meet, 1 = direct light only
    spp         work on indirect light, in paths per pixel; spent where the noise is, and partly on sharing paths. 1
                traces 2, whose difference tells the noise
    adaptive    whether it is spent so, or evenly and without sharing
    filter      whether late indirect light is averaged over regions of surfaces instead: far less noise, and a bias;
                left out where a pilot sees little gain, but without `adaptive`
    clamp       the most that one path of indirect light may add to a pixel, in units of the direct light around it:
                fireflies go, and some energy, which is measured and counted as an error
    grid        direct rays per pixel side: a pixel is cut into grid x grid cells, one ray and footprint each
    ambient     whether steady ambient light is rendered; open: if the scene has any and the budget has background
    ambient_spp paths per pixel of ambient light, 1 traces 2; open: as many as its noise asks for
    ambient_filtered  whether neighbouring pixels share the ambient light they reflect: far less noise, edges of shadows
                and reflections in it are blurred by some pixels
    error       target of the relative error (nRMSE of the expected counts on the reference sensor after the pulse)
    min_spp     least paths per pixel of indirect light where `spp` is open, also where a pilot sees little noise
    target_fraction  part of the squared target that is planned for; the rest is for what pilots miss. Above 1 where
                renders are known to come out better than planned
    direct_fraction  part of the target that direct light may be off where there is other light
    budget      (signal, background) photons per pixel: Monte-Carlo variance stays under 1 % of shot variance there
    edge_threshold  edges of surfaces and shadows are followed where they could change this share of a cell or more;
                0 follows all of them
    direct_tolerance_m, indirect_tolerance_m   returns of one pixel closer than this in path length merge; direct ones
                do not with 0; open: as wide as the target allows
    indirect_growth  that width grows by this share of the path behind the direct light
    refraction  whether solid glass bends direct light; open: where there is any, and the laser is at the camera

    Raises InputError for values out of range.

    Examples
    --------
    `render` takes these fields as keywords. A render is planned for a relative error, or for a photon budget:

    >>> import scene2spad as s2s
    >>> s2s.RenderSettings(error=0.01).budget is None
    True
    >>> s2s.RenderSettings(budget=(50, 20)).budget  # mean signal and background photons a pixel
    (50, 20)
    >>> transient = s2s.render("plane", width=4, height=3, bounces=1, error=0.01)
    >>> transient.meta["target_met"]
    True
    """

    bounces: int | None = None
    spp: int | None = None
    adaptive: bool = True
    filter: bool = False
    clamp: float | None = None
    grid: int | None = None
    ambient: bool | None = None
    ambient_spp: int | None = None
    ambient_filtered: bool = False
    error: float | None = None
    min_spp: int = MIN_SPP
    target_fraction: float = 0.75
    direct_fraction: float = 0.4
    budget: tuple[float, float] | None = None
    edge_threshold: float | None = None
    direct_tolerance_m: float | None = None
    indirect_tolerance_m: float | None = None
    indirect_growth: float | None = None
    refraction: Refraction | None = None

    def __post_init__(self) -> None:
        limits = (
            ("bounces", 1, MAX_BOUNCES),
            ("spp", 1, MAX_SAMPLES),
            ("clamp", 1e-3, 1e6),
            ("grid", 1, MAX_GRID),
            ("error", MIN_ERROR, 1.0),
            ("min_spp", 1, MAX_SAMPLES),
            ("target_fraction", 0.1, 2.0),
            ("direct_fraction", 0.05, 0.95),
            ("edge_threshold", 0, 1),
            ("ambient_spp", 1, 1 << 16),
            ("indirect_tolerance_m", 1e-4, 10),
        )
        for name, low, high in limits:
            value = getattr(self, name)
            if isinstance(value, bool):  # which Python compares as 0 and 1
                raise InputError(f"render: {name} {value} is no number, as it has to be from {low} to {high}")
            if value is not None and not low <= require_number(value, f"render: {name}") <= high:
                raise InputError(f"render: {name} {value} is outside {low} to {high}")
            if value is not None and name in WHOLE and not isinstance(value, Integral):
                raise InputError(f"render: {name} {value!r} is no whole number, as it has to be from {low} to {high}")
        normalise_fields(self, "render")
        if not (self.ambient is None or isinstance(self.ambient, bool)):
            raise InputError(f"render: ambient {self.ambient!r}, expected True, False or None")
        bends, ways = self.refraction, get_args(Refraction)
        if bends is not None and not (isinstance(bends, str) and bends in ways):
            raise InputError(f"render: refraction {bends!r}, expected {' or '.join(ways)}")
        if self.budget is not None:
            pair = list(self.budget) if isinstance(self.budget, tuple | list | np.ndarray) else []
            if len(pair) != 2 or not all(isinstance(mean, Real) for mean in pair):
                expected = "expected two numbers: signal and background photons a pixel"
                raise InputError(f"render: budget {self.budget!r}, {expected}")
            signal, background = (require_number(mean, "render: budget of") for mean in pair)
            object.__setattr__(self, "budget", (signal, background))
            if not (0 < signal <= MAX_PHOTONS and 0 <= background <= MAX_PHOTONS):
                raise InputError(
                    f"render: budget of {signal:g} signal, {background:g} background photons a pixel, expected signal "
                    f"above 0 and background of 0 or more, at most {MAX_PHOTONS:g}"
                )
        if self.budget is not None and self.error is not None:
            raise InputError("render: give an error target or a photon budget, not both")
        # cells of a smaller growth than that float32 cannot tell apart
        for name, high in (("direct_tolerance_m", 10), ("indirect_growth", 1)):
            value = getattr(self, name)
            if value is not None and value != 0 and not 1e-4 <= value <= high:
                raise InputError(f"render: {name} {value:g} is neither 0 nor 1e-4 to {high}")


@dataclass(frozen=True)
class Plan:
    """Plan of a render, and its reasons: one a line, stored with the result.

    spp         work on indirect light in paths per pixel; None: whatever `noise` takes
    indirect_tolerance_m, indirect_growth   cells of path in which returns of indirect light merge, as of the settings
    noise       target of the Monte-Carlo part of the error where spp is open
    target      that of the whole error
    refraction  of solid glass: direct light by Snell's law, or everything in a straight line
    left_out    share of all laser light that meets more surfaces than planned, where it is enough to matter
    ambient_noise  where the paths of ambient light are open: the noise at which they end
    """

    bounces: int
    spp: int | None
    grid: int
    ambient: bool
    reasons: tuple[str, ...]
    edge_threshold: float = 0.5
    direct_tolerance_m: float = 0.005
    indirect_tolerance_m: float = WIDEST_INDIRECT_M
    indirect_growth: float = WIDEST_GROWTH
    noise: float = 0.0
    target: float = 0.0
    adaptive: bool = True
    filter: bool = False
    ambient_noise: float = 0.0
    clamp: float | None = None
    refraction: Refraction = "straight"
    left_out: float = 0.0

    def to_dict(self) -> JsonObject:
        """Return all of it by name; light that is left out only where there is some that matters."""
        parts = asdict(self)
        return parts if self.left_out else {name: part for name, part in parts.items() if name != "left_out"}
