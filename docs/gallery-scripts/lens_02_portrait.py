"""
A portrait from a lamp
======================

A photograph on a screen by the light of a point; the curvature of the front is found together with the back.
The scene file is :download:`lens_02_portrait.toml`:

.. literalinclude:: lens_02_portrait.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_02_portrait.toml", progress=False)
report = design.write("outputs/lens_02_portrait", progress=False)
design.picture("outputs/lens_02_portrait/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_02_portrait/light.png")
