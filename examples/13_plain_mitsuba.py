# %% [markdown]
# # 13 Rendering from plain Mitsuba
# Our renderer is a plugin of Mitsuba. A scene of yours stays as it is: only the integrator changes.

# %%
import numpy as np

import scene2spad as s2s

s2s.register_integrator()  # starts Mitsuba, too
import mitsuba as mi  # noqa: E402

WIDTH, HEIGHT = 64, 48
place = mi.ScalarTransform4f()
camera = place.look_at([0, 1, 4], [0, 0.8, 0], [0, 1, 0])
scene = mi.load_dict(
    {
        "type": "scene",
        "integrator": {"type": "scene2spad", "temporal_bins": 300, "bin_width_opl": 0.03, "error": 0.1},
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": camera,
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT},
        },
        "wall": {"type": "rectangle", "to_world": place.scale(3)},
        "floor": {"type": "rectangle", "to_world": place.rotate([1, 0, 0], -90).scale(3)},
        "box": {"type": "cube", "to_world": place.translate([0.3, 0.6, 1]).scale(0.4)},
    }
)

# %% [markdown]
# The result is a dense array (rows, columns, optical path). Its bins are 3 cm of path, which is 0.1 ns.

# %%
data = np.array(mi.render(scene))
print(data.shape, data.dtype)
rows, columns = HEIGHT // 2, WIDTH // 2
first = np.flatnonzero(data[rows, columns])[0]
print(f"first light of the middle pixel: {first * 0.03:.2f} m of path, {first * 0.015:.2f} m away")

# %% [markdown]
# The same scene in XML needs one line: `<integrator type="scene2spad"/>`.

# %%
XML = """<scene version="3.0.0">
  <integrator type="scene2spad"><integer name="max_depth" value="2"/></integrator>
  <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>
    <integer name="height" value="6"/></film></sensor>
  <shape type="rectangle"><transform name="to_world"><translate z="2"/></transform></shape>
</scene>"""
wall = np.array(mi.render(mi.load_string(XML)))
arrival_m = np.argmax(wall[3, 4]) * 0.029277 / 2
print(f"{wall.shape}: a wall at 2 m is seen at {arrival_m:.2f} m")
