"""
Two pictures on two planes
==========================

A sheet of paper 100 mm behind the block shows one photograph, and 140 mm further on another one. The front sends light
to where the back needs it, and the back sends each ray through its two places. All rays cross on their way.
The scene file is :download:`lens_15_two_pictures.toml`:

.. literalinclude:: lens_15_two_pictures.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on both sheets as an eye sees it:

import bstcad

design = bstcad.design("lens_15_two_pictures.toml", progress=False)
report = design.write("outputs/lens_15_two_pictures", progress=False)
design.picture("outputs/lens_15_two_pictures/wall.png")
design.picture("outputs/lens_15_two_pictures/wall_2.png", target=1)
print(report)

# %%
# The lens at work:

design.show("outputs/lens_15_two_pictures/light.png")
