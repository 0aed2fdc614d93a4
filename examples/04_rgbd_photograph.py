# %% [markdown]
# # 04 An RGB-D photograph
# Depth, albedo and ambient light as images become a transient of direct light. No renderer is needed.

# %%
import numpy as np

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
column, row = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
depth_m = np.where(column**2 + row**2 < 0.4, 1.5, 2.5)  # a disk before a wall
albedo = np.where(row < 0, 0.7, 0.3)
ambient = np.full_like(depth_m, 0.01)  # W/(m^2 sr nm)
transient = s2s.transient_from_rgbd(depth_m, albedo, ambient)

# %% [markdown]
# Your own images: `s2s.load_scene` takes a folder of Middlebury files, and `np.asarray(PIL.Image.open(...))` any PNG.

# %%
histogram = s2s.sense(transient, signal=20, background=20, seed=4)
errors = s2s.depth_errors(s2s.estimate_depth(histogram), histogram)
print(f"{errors['mae_mm']:.1f} mm mean error over {errors['pixels']} pixels")
