# %% [markdown]
# # 13 Dense output for other programs
# A transient is a list of returns. Here it becomes an array (rows, columns, time), as other renderers write.

# %%
from pathlib import Path

import h5py

import scene2spad as s2s
from spad.formats.dense import dense_radiance, write_dense

WIDTH, HEIGHT = 64, 48
transient = s2s.render("corner", width=WIDTH, height=HEIGHT, bounces=3, error=0.1)
sensor = s2s.sensor_by_name("reference")
arrays = dense_radiance(transient, sensor)
print(arrays["data"].shape, arrays["data"].dtype)

# %% [markdown]
# Light is kept: the sum over time is the radiance of the pixel.

# %%
write_dense(arrays, Path("corner-dense.h5"))
with h5py.File("corner-dense.h5") as file:
    for name, values in file.items():
        print(f"{name} {values.shape} [{values.attrs['unit']}]: {values.attrs['description']}")
    difference = abs(file["data"][:].sum(axis=2) / transient.total_radiance() - 1).max()
print(f"largest relative difference of the sums: {difference:.1e}")
