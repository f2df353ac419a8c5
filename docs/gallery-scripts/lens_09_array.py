"""
Nine lenses on a plate
======================

One lens in parallel light, nine times on one plate, as a single solid with exact faces; all nine pictures overlap on
the wall.
The scene file is :download:`lens_09_array.toml`:

.. literalinclude:: lens_09_array.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_09_array.toml", progress=False)
report = design.write("outputs/lens_09_array", progress=False)
design.picture("outputs/lens_09_array/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_09_array/light.png")

# %%
# Nine copies on a plate with rounded corners become one solid:

import cadquery as cq
import pyvista

plate = cq.Workplane("XY", origin=(0, 0, 0.5)).rect(38, 38).extrude(1.0).edges("|Z").fillet(2.0)
part = bstcad.mounted(plate, [(design, (12 * i, 12 * j)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
print("valid:", part.isValid(), "volume:", round(part.Volume()), "mm³")
vertices, triangles = part.tessellate(0.02)
mesh = pyvista.PolyData.from_regular_faces([v.toTuple() for v in vertices], triangles)
scene = pyvista.Plotter(off_screen=True, window_size=(1200, 900))
scene.add_mesh(mesh, color="#a9d3ee", specular=0.6, smooth_shading=True, split_sharp_edges=True)
scene.camera_position = [(45, -60, 55), (0, 0, 1), (0, 0, 1)]
scene.screenshot("outputs/lens_09_array/part.png")
