# %% [markdown]
# # 02 Your own mesh, from several sides
# Any .obj, .ply, .stl or .glb is put on a floor before a wall. Here trimesh makes one.

# %%
from dataclasses import replace

import numpy as np
import trimesh

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
trimesh.creation.box((0.6, 0.4, 0.2)).export("box.ply")
scene = s2s.load_scene("box.ply", width=WIDTH, height=HEIGHT)
print(len(scene.surfaces), "surfaces")

# %% [markdown]
# The camera is part of the scene, and scenes are never changed: `replace` gives a new one. Metres, y up.

# %%
for degrees in (0, 30, 60):
    angle = np.radians(degrees)
    origin = (1.5 * np.sin(angle), 0.6, 1.5 * np.cos(angle))
    camera = s2s.Camera.look_at(origin, (0, 0.3, 0), fov_deg=45, width=WIDTH, height=HEIGHT)
    transient = s2s.render(replace(scene, camera=camera), bounces=1)
    print(f"{degrees} degrees: the box is {transient.depth_m[HEIGHT // 2, WIDTH // 2]:.2f} m away in the middle")
