# %% [markdown]
# # 11 The depth offset in miniature
# A learned code of all 1,024 bins knows the depths it was trained on. A delay of the light shows that.

# %%
import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
transient = s2s.render("rooms/test/0", width=WIDTH, height=HEIGHT, bounces=1)
MODELS = ("learned-1024x1x1-128x-s0", "fourier-1024x1x1-128x-s0", "learned-256x4x4-128x-s0")

# %% [markdown]
# `delayed(7)` is the same scene 7 m farther in time alone: the counts are the same, only later.

# %%
for offset_m in (0, 7):
    histogram = s2s.sense(transient.delayed(offset_m), signal=10, background=10, seed=11)
    for name in MODELS:
        errors = s2s.depth_errors(s2s.estimate_depth(histogram, name), histogram)
        print(f"{offset_m} m farther, {name}: {errors['mae_mm']:.0f} mm mean error")
