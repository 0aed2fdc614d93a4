"""One exposure drawn in other forms and in parts: timestamps, pieces of cycles, progress, and limits of memory."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_flux import transient_of
from test_laws import SMALL, same

from scenes import InputError
from spad.detection.detect import sense, sense_timestamps
from spad.detection.exposure import draw_part
from spad.measurements.timestamps import Timestamps
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.tdc import Tdc

REFERENCE = Sensor()


@pytest.mark.parametrize(
    ("model", "signal"), [("poisson", 30), ("poisson", 1e4), ("first-photon", 30), ("free-running", 30)]
)
@pytest.mark.parametrize("crosstalk", [0.0, 0.01])
def test_timestamps_and_histogram_are_one_draw(model: str, signal: float, crosstalk: float) -> None:
    sensor = replace(REFERENCE, crosstalk=crosstalk, dead_time_s=2e-8)
    scene, budget = same(1500 if signal < 100 else 20, (4.0, 4.1, 1.0)), PhotonBudget(signal, 20)
    stamps = sense_timestamps(scene, sensor, budget, seed=2, model=model)
    counts = sense(scene, sensor, budget, seed=2, model=model).counts
    assert (stamps.counts() == counts).all()
    again = Timestamps.of_counts(counts)
    assert (again.stamps == stamps.stamps).all() and (again.offsets == stamps.offsets).all()


def test_pieces_of_an_exposure_are_the_exposure_and_report_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Event by event an exposure of many photons is drawn some cycles at a time: dead time lasts over the seams."""
    cycles = 400
    sensor = replace(SMALL, exposure_s=cycles * SMALL.period_s, dead_time_s=2.2 * SMALL.period_s)
    scene, budget = same(400, (0.5, 0.6, 1.0)), PhotonBudget(0.5 * cycles, 0.3 * cycles)
    whole = sense(scene, sensor, budget, seed=1, model="free-running").counts[0]
    monkeypatch.setattr("spad.detection.detectors.MAX_EVENTS", 400 * 0.8 * cycles / 40)
    done: list[float] = []
    report = lambda what, fraction: done.append(fraction)  # noqa: E731
    pieces = sense(scene, sensor, budget, seed=1, model="free-running", progress=report).counts[0]
    # about 40 pieces, a report after each; the budget's mean is reached to rounding
    assert len(done) in (41, 42) and done == sorted(done) and done[0] == 0 and done[-1] == pytest.approx(1)
    both = np.stack([pieces.sum(axis=0), whole.sum(axis=0)])
    assert stats.chi2_contingency(both[:, both.sum(axis=0) > 20]).pvalue > 1e-3
    # forgetting the dead time at 40 seams would add 0.5 tau's worth of detections at each: 10 % here
    assert both.sum(axis=1)[0] == pytest.approx(both.sum(axis=1)[1], rel=5 * np.sqrt(2 / both[1].sum()))


@pytest.mark.parametrize("crosstalk", [0.0, 0.01])
@pytest.mark.parametrize("model", ["poisson", "first-photon", "free-running"])
def test_progress_ends_at_one_whatever_the_law(model: str, crosstalk: float) -> None:
    """Two blocks of pixels, on however many threads."""
    done: list[float] = []
    report = lambda what, fraction: done.append(fraction)  # noqa: E731
    sensor = replace(SMALL, exposure_s=100 * SMALL.period_s, crosstalk=crosstalk)
    scene = same(1100, (0.5, 0.6, 1.0))
    sense(scene, sensor, PhotonBudget(30.0, 20.0), seed=1, model=model, progress=report)
    assert done == sorted(done) and done[0] == 0 and done[-1] == pytest.approx(1) and len(done) >= 3


@pytest.mark.parametrize(
    ("model", "many", "lines"), [("free-running", 50, 1), ("free-running", 1e7, 0), ("poisson", 50, 0)]
)
def test_many_events_that_are_drawn_one_by_one_are_said_before(model, many, lines, monkeypatch, caplog) -> None:
    monkeypatch.setattr("spad.detection.exposure.MANY_EVENTS", many)
    said = lambda *_: pytest.fail("drawn before it was said") if len(caplog.records) < lines else None  # noqa: E731
    with caplog.at_level("INFO", logger="spad"):
        sense(same(4, (0.5, 0.6, 1.0)), SMALL, PhotonBudget(20.0, 10.0), seed=1, model=model, progress=said)
    assert [record.message for record in caplog.records] == [
        "free-running: 120 photons are drawn one by one; fewer photons or a shorter exposure take less time"
    ] * lines


@pytest.mark.parametrize("model", ["poisson", "first-photon"])
def test_blocks_of_very_many_photons_are_drawn_in_parts(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One pixel of 40 is far brighter: its bins are drawn at once, those around it photon by photon, all by one law."""
    returns = [[(0.5, 0.9, 1.0)] for _ in range(40)]
    returns[17] = [(0.5, 0.9, 400.0)]
    scene, budget = transient_of(*returns), PhotonBudget(100.0, 20.0)
    scene = replace(scene, ambient=np.ones((1, 40), np.float32))
    sensor = replace(SMALL, exposure_s=1e5 * SMALL.period_s)
    usual = sense(scene, sensor, budget, seed=1, model=model).counts
    shapes = []
    monkeypatch.setattr("spad.detection.exposure.MAX_HELD", 200)
    recording = lambda *given: shapes.append(draw_part(*given)) or shapes[-1]  # noqa: E731
    monkeypatch.setattr("spad.detection.exposure.draw_part", recording)
    drawn = sense(scene, sensor, budget, seed=2, model=model).counts
    assert max(array.size for array in shapes) < 200 + 5 * np.sqrt(200) and any(array.ndim == 2 for array in shapes)
    assert np.array_equal(sense_timestamps(scene, sensor, budget, seed=2, model=model).counts(), drawn)
    both = np.stack([usual[0].sum(axis=0), drawn[0].sum(axis=0)])
    assert stats.chi2_contingency(both[:, both.sum(axis=0) > 20]).pvalue > 1e-3
    pixels = np.stack([usual.sum(axis=2)[0], drawn.sum(axis=2)[0]])
    assert (np.abs(pixels[0] - pixels[1]) < 5 * np.sqrt(pixels.sum(axis=0)) + 1).all()


def test_a_histogram_larger_than_memory_is_refused_before_it_is_allocated(monkeypatch):
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "1e-6")
    with pytest.raises(InputError, match=r"a histogram of 1 x 1 pixels and 1024 bins: needs .* GB of memory"):
        sense(transient_of([(4.0, 4.02, 1.0)]), Sensor(), PhotonBudget(40, 60))


@pytest.mark.parametrize(
    ("law", "expected", "exposure"),
    [("first-photon", "6e+09", 1e-3), ("free-running", "6e+09", 1.0), ("poisson", "6e+09", 1e-3)],
)
def test_crosstalk_of_too_many_detections_is_refused_before_any_is_drawn(law, expected, exposure, monkeypatch):
    """First photons of 10,000 cycles would be few, but all photons of a block are drawn for them."""

    def draw(*_, **__):
        raise AssertionError("photons were drawn")

    monkeypatch.setattr("spad.detection.detectors.draw_primaries", draw)
    sensor = Sensor(crosstalk=0.01, dead_time_s=1e-8, exposure_s=exposure, tdc=Tdc(Sensor().period_s / 8, codes=128))
    light = same(10, (3.0, 3.0, 1.0))
    with pytest.raises(
        InputError, match=r"crosstalk event by event: .* would be held at once, the limit is 67108864"
    ) as caught:
        sense(light, sensor, PhotonBudget(3e8, 3e8), model=law)
    assert expected in str(caught.value)
