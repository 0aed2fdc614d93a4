# %% [markdown]
# # 03 A Mitsuba scene
# Geometry, materials and camera of a Mitsuba file are kept. Its lights become ambient light, the laser is ours.

# %%
from pathlib import Path

import scene2spad as s2s

WIDTH, HEIGHT = 64, 48
Path("box.xml").write_text("""<scene version="3.0.0">
  <sensor type="perspective">
    <float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="0, 1, 3" target="0, 0.5, 0" up="0, 1, 0"/></transform>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.6, 0.6"/></bsdf>
  </shape>
  <shape type="sphere">
    <point name="center" x="0" y="0.5" z="0"/><float name="radius" value="0.5"/>
    <bsdf type="roughplastic"><float name="alpha" value="0.2"/></bsdf>
  </shape>
</scene>""")

# %%
transient = s2s.render("box.xml", width=WIDTH, height=HEIGHT, bounces=3, error=0.1)
print(transient)
for note in transient.meta["notes"]:
    print("note:", note)
print(f"light that met two surfaces or more: {transient.indirect_fraction:.1%}")
