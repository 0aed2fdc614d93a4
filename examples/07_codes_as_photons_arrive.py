# %% [markdown]
# # 07 Codes as timestamps arrive
# A sensor that keeps K codes adds one column of the code for each photon. It never holds a histogram.

# %%
import numpy as np
import torch

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
transient = s2s.render("gallery", width=WIDTH, height=HEIGHT, bounces=1, seed=7)
histogram = s2s.sense(transient, signal=20, background=20, seed=7)
timestamps, offsets = histogram.timestamps()
codes = s2s.coding_tensor("fourier", 8)

# %%
kept = s2s.encode_timestamps(torch.from_numpy(timestamps.astype(np.int64)), torch.from_numpy(offsets), codes)
dense = s2s.encode(histogram.counts, codes).reshape(-1, codes.codes)
print("numbers a pixel:", codes.codes, "instead of", codes.bins)
print(f"largest difference to codes of the histogram: {float((kept - dense).abs().max()):.1e}")

# %%
depth_m = s2s.decode_depth(kept, codes, histogram.sensor).numpy().reshape(HEIGHT, WIDTH)
print(f"{s2s.depth_errors(depth_m, histogram)['mae_mm']:.1f} mm mean error")
