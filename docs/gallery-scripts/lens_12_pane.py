"""
A window pane of 400 mm
=======================

A pane of float glass in the sun writes a word on a floor 2 m away. The blur of the sun, 19 mm, is as wide as the
strokes.
The scene file is :download:`lens_12_pane.toml`:

.. literalinclude:: lens_12_pane.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_12_pane.toml", progress=False)
report = design.write("outputs/lens_12_pane", progress=False)
design.picture("outputs/lens_12_pane/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_12_pane/light.png")
