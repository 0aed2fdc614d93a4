# %% [markdown]
# # 06 Pile-up, dead time and Coates
# A synchronous detector keeps the first photon of each cycle. Strong light then hides what comes later.

# %%
import numpy as np

import scene2spad as s2s

WIDTH, HEIGHT = 32, 24
depth_m = np.full((HEIGHT, WIDTH), 9.0)
wall = s2s.transient_from_rgbd(depth_m, np.ones_like(depth_m), np.ones_like(depth_m))
sensor = s2s.Sensor(exposure_s=1e-4)  # 1,000 cycles of 100 ns
histogram = s2s.sense(wall, sensor=sensor, signal=500, background=2500, law="first-photon", seed=6)
for reason in histogram.meta["plan"]:
    print(reason)

# %% [markdown]
# Early bins are fuller than late ones, although the background is uniform. Coates' estimate undoes that.

# %%
mean = histogram.counts.mean(axis=(0, 1))
print(f"mean counts of a bin: {mean[:100].mean():.2f} early, {mean[-100:].mean():.2f} late")
for method in ("log-matched", "coates"):
    errors = s2s.depth_errors(s2s.estimate_depth(histogram, method), histogram)
    print(f"{method}: {errors['mae_mm']:.1f} mm mean error, {errors['median_mm']:+.1f} mm median")
