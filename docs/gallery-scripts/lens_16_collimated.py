"""
A portrait that stays
=====================

A laser beam leaves the lens as a portrait, and parallel, so that sheets before and behind the stated one show it too.
The map of the OPD compares the light behind the lens with a plane wave.
The scene file is :download:`lens_16_collimated.toml`:

.. literalinclude:: lens_16_collimated.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the sheet as an eye sees it:

import bstcad

design = bstcad.design("lens_16_collimated.toml", progress=False)
report = design.write("outputs/lens_16_collimated", progress=False)
design.picture("outputs/lens_16_collimated/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_16_collimated/light.png")
