"""
A portrait in the sun
=====================

A plate of 100 mm throws a portrait on a wall at 250 mm. The sun is half a degree wide: detail finer than 2.3 mm
cannot come back.
The scene file is :download:`lens_05_sun.toml`:

.. literalinclude:: lens_05_sun.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_05_sun.toml", progress=False)
report = design.write("outputs/lens_05_sun", progress=False)
design.picture("outputs/lens_05_sun/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_05_sun/light.png")
