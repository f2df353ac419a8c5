"""
Letters, off the axis
=====================

Three letters 1 m behind a block of PMMA, beside the axis of a widened laser beam: the geometry of example 2 of Wang
et al. 2023.
The scene file is :download:`lens_01_letters.toml`:

.. literalinclude:: lens_01_letters.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_01_letters.toml", progress=False)
report = design.write("outputs/lens_01_letters", progress=False)
design.picture("outputs/lens_01_letters/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_01_letters/light.png")
