# %% [markdown]
# # 05 From a data sheet to range
# Laser power, lens, detection efficiency, dark counts and sunlight give the photons of a wall at 5 and 50 m.

# %%
import numpy as np

import scene2spad as s2s

WIDTH, HEIGHT = 16, 16
sensor = s2s.Sensor(bins=4096, bin_width_s=100e-12, exposure_s=1 / 30, pde=0.2, dark_count_rate_hz=125)
optics = s2s.Optics(
    pulse_energy_j=100e-9,  # 100 nJ; at one pulse each 410 ns that is 0.24 W
    focal_length_m=10e-3,
    f_number=2.0,
    pixel_pitch_m=20e-6,
    transmission=0.7,
    filter_nm=1.0,
)
cone_sr, albedo = np.radians(20) ** 2, 0.1
sunlit = 0.82 * albedo / np.pi  # radiance of a wall in the sun [W/(m^2 sr nm)]

# %% [markdown]
# The cone of the laser goes into the albedo: `transient_from_rgbd` is lit by 1 W/sr.

# %%
image = np.ones((HEIGHT, WIDTH))
for distance_m in (5, 50):
    wall = s2s.transient_from_rgbd(distance_m * image, albedo / cone_sr * image, sunlit * image)
    histogram = s2s.sense(wall, sensor=sensor, optics=optics, seed=5)
    signal, background = histogram.budget.signal, histogram.budget.background
    within = s2s.depth_errors(s2s.estimate_depth(histogram), histogram)["within_10mm"]
    print(f"{distance_m} m: {signal:.1f} signal and {background:.0f} background detections a pixel")
    print(f"   signal over shot noise {signal / np.sqrt(signal + background):.2f}, within 10 mm: {within:.0%}")
