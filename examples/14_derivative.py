# %% [markdown]
# # 14 Derivative of expected counts by albedo and pose
# Renders with one seed share their random numbers. Differences between two of them are then derivatives, not noise.

# %%
from dataclasses import replace

import numpy as np

import scene2spad as s2s
from scenes.constants import SPEED_OF_LIGHT_M_PER_S

WIDTH, HEIGHT = 32, 24
SENSOR = s2s.sensor_by_name("reference")
wall = s2s.load_scene("wall@2", width=WIDTH, height=HEIGHT)
light = s2s.render(wall, bounces=1, seed=14)
counts_per_radiance = 50 / light.total_radiance().mean()  # this laser brings 50 photons a pixel from this wall


def expected_counts(scene: s2s.Scene) -> np.ndarray:
    """Return the expected signal detections (H, W, T) of one exposure."""
    return counts_per_radiance * s2s.dense(s2s.render(scene, bounces=1, seed=14), SENSOR)["data"]


def with_albedo(albedo: float) -> s2s.Scene:
    surfaces = tuple(replace(one, material=replace(one.material, albedo=albedo)) for one in wall.surfaces)
    return replace(wall, surfaces=surfaces)


def moved(back_m: float) -> s2s.Scene:
    """Return the scene with the camera and its laser moved back along the view axis."""
    pose = wall.camera.pose.copy()
    pose[:3, 3] -= back_m * pose[:3, 2]
    return replace(wall, camera=replace(wall.camera, pose=pose))


# %% [markdown]
# Direct light is proportional to the albedo: the derivative is counts over albedo, in every bin.

# %%
step, albedo = 0.01, wall.surfaces[0].material.albedo
assert isinstance(albedo, float)  # and no texture
slope = (expected_counts(with_albedo(albedo + step)) - expected_counts(with_albedo(albedo - step))) / (2 * step)
here = expected_counts(wall)
print(f"by albedo: largest error of a bin {np.abs(slope - here / albedo).max() / slope.max():.1e} of the largest slope")

# %% [markdown]
# A camera that moves back sees less light, and sees it later: counts fall by 2 / distance, paths grow by 2 m per metre.

# %%
near, far = (expected_counts(moved(one))[HEIGHT // 2, WIDTH // 2] for one in (-step, step))
slope = (far - near) / (2 * step)
here = here[HEIGHT // 2, WIDTH // 2]
path_m = (np.arange(SENSOR.bins) + 0.5) * SENSOR.bin_width_s * SPEED_OF_LIGHT_M_PER_S
growth = (far @ path_m / far.sum() - near @ path_m / near.sum()) / (2 * step)
print(f"by pose: counts {slope.sum() / here.sum():.3f} per m, expected {-2 / 2.0:.3f}; path {growth:.3f}, expected 2")
print(f"steepest bins: {slope.min():.0f} and {slope.max():.0f} counts per m")
