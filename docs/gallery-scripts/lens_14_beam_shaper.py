"""
A beam shaper
=============

Both faces of a rod of fused silica are freeform: the front spreads the middle of a Gaussian laser beam, and the back
makes the light parallel again. The disc is even, and stays so as far as diffraction allows. The map of the OPD compares
the light behind the lens with a plane wave.
The scene file is :download:`lens_14_beam_shaper.toml`:

.. literalinclude:: lens_14_beam_shaper.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the disc as an eye sees it:

import bstcad

design = bstcad.design("lens_14_beam_shaper.toml", progress=False)
report = design.write("outputs/lens_14_beam_shaper", progress=False)
design.picture("outputs/lens_14_beam_shaper/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_14_beam_shaper/light.png")
