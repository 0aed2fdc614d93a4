"""Read a periodic network near the ends of its range, where a posterior is on both; and networks of other clocks."""

from dataclasses import replace

import numpy as np
import torch

from csph.networks.checkpoint import load_model
from csph.networks.periodic import ENDS_BINS
from csph.weights.cards import checkpoint_of
from scene2spad.cli import main
from scene2spad.networks.end_warnings import warn_of_ends
from spad.measurements.histogram import Histogram, write_histogram
from spad.sensor.model import PhotonBudget
from spad.sensor.template import binned_pulse

NAME = "fourier-1024x1x1-128x-periodic-s1"


def wall_at(bins: float, sensor) -> Histogram:
    """Return the counts of 8 x 8 pixels whose photons come so many bins after the start."""
    pulse = binned_pulse(torch.tensor([bins * sensor.bin_width_s], dtype=torch.float64), sensor)[0].numpy()
    counts = np.random.default_rng(1).poisson(50 * pulse + 50 / sensor.bins, (8, 8, sensor.bins)).astype(np.int32)
    depth = np.full((8, 8), bins * sensor.bin_depth_m, np.float32)
    ones = np.ones((8, 8), np.float32)
    mixed, albedo = np.zeros((8, 8), bool), ones.astype(np.float16)
    return Histogram(counts, sensor, PhotonBudget(50, 50), depth, mixed, albedo, 50 * ones, 50 * ones)


def test_the_mean_fails_where_it_is_said_to_and_the_median_does_not(tmp_path, capfd):
    model = load_model(checkpoint_of(NAME))[0]
    sensor = model.config.sensor
    worst = {}
    for bins in (1.0, sensor.bins - 1.0, ENDS_BINS + 1.0, sensor.bins - ENDS_BINS - 1.0):
        histogram = wall_at(bins, sensor)
        for decoder in ("median", "soft-argmax"):
            error = np.abs(model.depth_of(histogram, decoder=decoder)[0] - histogram.depth_m)
            worst[bins, decoder] = float(np.median(np.minimum(error, sensor.range_m - error)))
    far = {key: error for key, error in worst.items() if error > 0.1}
    assert far.keys() == {(1.0, "soft-argmax"), (sensor.bins - 1.0, "soft-argmax")} and min(far.values()) > 1
    write_histogram(wall_at(1.0, sensor), tmp_path / "wall.h5")
    asked = ["depth", str(tmp_path / "wall.h5"), "--method", "network", "--model", NAME, "--no-figure", "--decoder"]
    for decoder, warned in (("soft-argmax", True), ("median", False)):
        assert main([*asked, decoder]) == 0
        told = f"{NAME}: its time is a circle" in capfd.readouterr().err
        assert told == warned


def test_only_means_on_a_circle_are_warned_of(caplog):
    periodic = load_model(checkpoint_of(NAME))[0].config
    warn_of_ends("m", periodic, None)
    warn_of_ends("m", replace(periodic, network="compact"), "soft-argmax")
    assert not caplog.records


def test_a_network_of_another_clock_is_warned_of(tmp_path, capfd):
    for name, warned in (("learned-1024x1x1-128x-tdc-s0", True), ("learned-1024x1x1-128x-s0", False)):
        write_histogram(wall_at(40.0, load_model(checkpoint_of(NAME))[0].config.sensor), tmp_path / "wall.h5")
        asked = ["depth", str(tmp_path / "wall.h5"), "--method", "network", "--model", name, "--no-figure"]
        assert main(asked) == 0
        told = f"{name}: it was trained for the clock of reference-tdc, and this has bins of one width"
        assert (told in capfd.readouterr().err) == warned
