"""
A lens with a flange
====================

The lens is cut to a round rim and held by a flange with four screw holes: one solid, ``part.step``, whose light is
proved.
The scene file is :download:`lens_08_flange.toml`:

.. literalinclude:: lens_08_flange.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_08_flange.toml", progress=False)
report = design.write("outputs/lens_08_flange", progress=False)
design.picture("outputs/lens_08_flange/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_08_flange/light.png")
