# %% [markdown]
# # 08 Your own K x T code
# Any matrix with a row for each code and a column for each time bin can be compared with the known ones.

# %%
import numpy as np
import torch

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
transient = s2s.render("gallery", width=WIDTH, height=HEIGHT, bounces=1, seed=8)
histogram = s2s.sense(transient, signal=50, background=50, seed=8)

# %% [markdown]
# Ours: chirps, whose frequency rises along the range.

# %%
time = (np.arange(1024) + 0.5) / 1024
rows = [np.cos(2 * np.pi * (k * time + (k + 1) * time**2) + phase) for k in range(4) for phase in (0, np.pi / 2)]
matrix = np.array(rows) - np.mean(rows, axis=1, keepdims=True)  # a uniform background then encodes to zero
mine = s2s.CodingTensor("chirp-8", torch.from_numpy(matrix.astype(np.float32)))
np.save("chirp-8.npy", matrix)  # for: scene2spad compare my.h5 --methods chirp-8.npy fourier-8

# %%
network = "learned-256x4x4-128x-mixed-s0"
methods: dict[str, s2s.CodingTensor | str] = {
    "chirp-8": mine,
    "fourier-8": s2s.coding_tensor("fourier", 8),
    "learned, 128x": network,
}
for name, method in methods.items():
    errors = s2s.depth_errors(s2s.estimate_depth(histogram, method), histogram)
    print(f"{name}: {errors['mae_mm']:.1f} mm mean error, {errors['within_10mm']:.0%} within 10 mm")
