# %% [markdown]
# # 01 First photons
# A room is rendered, a sensor counts photons, and an estimator turns counts into depth.

# %%
import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
transient = s2s.render("living-room", width=WIDTH, height=HEIGHT, bounces=1, seed=1)
print(transient)

# %% [markdown]
# Ten signal photons and fifty of background reach the average pixel. `counts` has rows, columns and time bins.

# %%
histogram = s2s.sense(transient, signal=10, background=50, seed=1)
print(histogram.counts.shape, int(histogram.counts.sum()), "detections")

# %%
for method in ("argmax", "matched", "log-matched"):
    depth_m = s2s.estimate_depth(histogram, method)
    errors = s2s.depth_errors(depth_m, histogram)
    print(f"{method}: {errors['mae_mm']:.1f} mm mean error, {errors['within_10mm']:.0%} within 10 mm")
