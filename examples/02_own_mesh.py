# %% [markdown]
# # 02 Your own mesh, from several sides
# Any .obj, .ply, .stl or .glb is put on a floor before a wall. Here trimesh makes one.

# %%
from dataclasses import replace

import numpy as np
import trimesh

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
trimesh.creation.icosphere(subdivisions=4, radius=0.3).export("ball.ply")
scene = s2s.load_scene("ball.ply", width=WIDTH, height=HEIGHT)
print(len(scene.surfaces), "surfaces")

# %% [markdown]
# The camera is part of the scene, and scenes are never changed: `replace` gives a new one. Metres, y up.

# %%
for degrees in (-20, 0, 20):
    angle = np.radians(degrees)
    origin = (1.5 * np.sin(angle), 0.6, 1.5 * np.cos(angle))
    camera = s2s.Camera.look_at(origin, (0, 0.3, 0), fov_deg=45, width=WIDTH, height=HEIGHT)
    transient = s2s.render(replace(scene, camera=camera), bounces=1)
    print(f"{degrees:+d} degrees: nearest surface at {np.nanmin(transient.depth_m):.2f} m")
