# %% [markdown]
# # 12 From a real sensor's captures to a calibrated model
# A TMF8820 looked at a plane from 119 distances. Its clock, pulse, gains and background are fitted to some of them.

# %%
from scene2spad.datasets.zone_captures import read_plane_captures, shipped_captures, within, zone_captures
from spad.sensor.files import load_sensor
from spad.zones.calibration import calibrate, poisson_deviance
from spad.zones.simulation import expected_zone_counts

EVERY = 3  # fit every third capture
captures = within(read_plane_captures(shipped_captures()), 0.25)
start = load_sensor("tmf8820")
assert start.zones is not None  # sensors of pixels have none
views = zone_captures(captures, start.sensor, start.zones)
print(len(views), "captures from", captures.distance_m[0], "to", captures.distance_m[-1], "m")

# %%
fitted = calibrate(views[::EVERY], start.sensor, start.zones)
print(f"bin width {fitted.sensor.bin_width_s * 1e12:.2f} ps, data sheet {start.sensor.bin_width_s * 1e12:.0f} ps")

# %% [markdown]
# Held-out captures say how good the model is: a deviance of 1 a bin would be as good as shot noise allows.

# %%
held = views[1::EVERY]
expected = [expected_zone_counts(v.returns, fitted.sensor, fitted.zones, v.drift_s) for v in held]
total = sum(poisson_deviance(v.counts, e) for v, e in zip(held, expected, strict=True))
print(f"deviance of {len(held)} held-out captures: {total / sum(v.counts.size for v in held):.2f} a bin")
