# %% [markdown]
# # 14 How counts change with albedo and pose
# Renders with one seed share their random numbers. Differences between two of them are then derivatives, not noise.

# %%
from dataclasses import replace

import scene2spad as s2s

WIDTH, HEIGHT = 32, 24
scene = s2s.load_scene("plane", width=WIDTH, height=HEIGHT)


def radiance(scene: s2s.Scene) -> float:
    """Return the mean radiance per joule [1/(m^2 sr)] of direct light."""
    return float(s2s.render(scene, bounces=1, seed=14).total_radiance().mean())


def with_albedo(albedo: float) -> s2s.Scene:
    surfaces = tuple(replace(one, material=replace(one.material, albedo=albedo)) for one in scene.surfaces)
    return replace(scene, surfaces=surfaces)


# %% [markdown]
# Direct light is proportional to the albedo: its derivative is radiance over albedo.

# %%
step = 0.01
slope = (radiance(with_albedo(0.5 + step)) - radiance(with_albedo(0.5 - step))) / (2 * step)
print(f"by albedo: {slope:.6f}, expected {radiance(with_albedo(0.5)) / 0.5:.6f}")

# %% [markdown]
# Of a wall that moves away, light falls with the square of distance: its derivative is -2 / distance.

# %%
near, here, far = (radiance(s2s.load_scene(f"wall@{d}", width=WIDTH, height=HEIGHT)) for d in (1.99, 2.0, 2.01))
print(f"by distance, relative: {(far - near) / 0.02 / here:.4f} per m, expected {-2 / 2.0:.4f}")
