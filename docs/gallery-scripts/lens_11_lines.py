"""
A line drawing
==============

Thin bright lines on black: all light has to be gathered into a tenth of the area.
The scene file is :download:`lens_11_lines.toml`:

.. literalinclude:: lens_11_lines.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

import bstcad

t = np.linspace(0, 2 * np.pi, 2000)
radius = 110 * np.cos(5 * t)  # a rose of five petals
drawing = Image.new("L", (256, 256))
ImageDraw.Draw(drawing).line(
    np.stack([128 + radius * np.cos(t), 128 + radius * np.sin(t)], axis=1).ravel().tolist(), fill=255, width=5
)
lines = np.asarray(drawing.filter(ImageFilter.GaussianBlur(1.0))) / 255.0
scene = bstcad.load("lens_11_lines.toml").changed({"target.image": lines})
design = bstcad.design(scene, progress=False)
report = design.write("outputs/lens_11_lines", progress=False)
design.picture("outputs/lens_11_lines/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_11_lines/light.png")
