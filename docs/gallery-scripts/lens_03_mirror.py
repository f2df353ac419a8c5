"""
A portrait by a mirror
======================

The same photograph on the wall above and beside a lamp, by a freeform mirror below it.
The scene file is :download:`lens_03_mirror.toml`:

.. literalinclude:: lens_03_mirror.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_03_mirror.toml", progress=False)
report = design.write("outputs/lens_03_mirror", progress=False)
design.picture("outputs/lens_03_mirror/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_03_mirror/light.png")
