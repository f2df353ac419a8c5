"""
A word in white light
=====================

Three laser lines are mixed to white. The index of the glass differs from line to line, so that edges far from the
axis part by colour.
The scene file is :download:`lens_06_white.toml`:

.. literalinclude:: lens_06_white.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_06_white.toml", progress=False)
report = design.write("outputs/lens_06_white", progress=False)
design.picture("outputs/lens_06_white/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_06_white/light.png")
