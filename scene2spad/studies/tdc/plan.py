"""Define what `study tdc` runs: clocks, models, classical methods, views, photon levels. Plain data."""

from __future__ import annotations

from dataclasses import dataclass, replace

from scene2spad.networks.registry import TDC_SENSOR, ModelSpec
from spad.sensor.files import load_sensor
from spad.sensor.model import Sensor
from spad.sensor.tdc import Tdc

Level = tuple[float, float]
PERFECT, REAL, DELAY, LINE, TABLE = "perfect", "real", "delay", "line", "table"
FOLDED, TRAINED = "folded", "trained"
CLOCKS = {
    PERFECT: "1,024 equal codes",
    REAL: "the table's codes, uncorrected",
    DELAY: "uncorrected; the mean delay of all pixels is taken off the depth, down to 0",
    LINE: "a straight line a pixel before summing",
    TABLE: "a look-up table a pixel before summing",
    FOLDED: "real codes, each pixel's rows of C averaged over its codes' true times; of a histogram, recalibrated",
    TRAINED: "real codes, network and codes trained further with them",
}
TABLE_BITS = 7  # of an entry: steps of 20 ps, a fifth of a bin; more change nothing (docs/tdc.md)
WITHIN = 0.05  # of the perfect clock's MAE: what a corrected code may lose
TEST_SET = "tabletop"
FILTER = "log-matched"
ON_CHIP = ModelSpec("fourier+learned", (256, 2, 2))
MODELS = (
    ModelSpec("learned", (1024, 1, 1)),
    ModelSpec("learned", (256, 4, 4)),
    ModelSpec("learned", (1024, 4, 4)),
    ModelSpec("fourier", (1024, 1, 1)),
    ON_CHIP,
)
TUNED = tuple(replace(one, tdc=True) for one in MODELS[:2])
CLASSICAL = ("fourier-8", "gray-8", "coarse-8", FILTER)


def sensor_of(clock: str) -> Sensor:
    """Return the sensor behind a clock, `perfect` too as a converter, so that all clocks see the same photons."""
    sensor = load_sensor(TDC_SENSOR).sensor
    assert sensor.tdc is not None
    if clock == PERFECT:
        return replace(sensor, tdc=Tdc(sensor.period_s, codes=sensor.bins))
    how = {LINE: "line", TABLE: "table"}.get(clock, "none")
    return replace(sensor, tdc=replace(sensor.tdc, correction=how, correction_bits=TABLE_BITS))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Plan:
    """Extent of the study: views of TEST_SET, (width, height), at every level."""

    models: tuple[ModelSpec, ...] = MODELS
    tuned: tuple[ModelSpec, ...] = TUNED
    classical: tuple[str, ...] = CLASSICAL
    on_chip: ModelSpec | None = ON_CHIP
    views: int = 8
    size: tuple[int, int] = (32, 32)
    levels: tuple[Level, ...] = ((10.0, 10.0), (50.0, 50.0))

    @property
    def wanted(self) -> tuple[ModelSpec, ...]:
        return (*self.models, *self.tuned)


SMOKE = Plan(
    models=(MODELS[1], ON_CHIP),
    tuned=TUNED[1:],
    classical=("fourier-8", FILTER),
    views=2,
    size=(24, 16),
    levels=((50.0, 50.0),),
)


def plan_of(preset: str) -> Plan:
    return SMOKE if preset == "smoke" else Plan()
