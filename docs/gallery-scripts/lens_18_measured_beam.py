"""
A top hat from a beam with a hot spot
=====================================

The picture of a beam, as from a camera, shows a hot spot and a slope from left to right. The lens for this beam makes
it an even disc with a soft edge.
The scene file is :download:`lens_18_measured_beam.toml`:

.. literalinclude:: lens_18_measured_beam.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the screen as an eye sees it:

import bstcad

design = bstcad.design("lens_18_measured_beam.toml", progress=False)
report = design.write("outputs/lens_18_measured_beam", progress=False)
design.picture("outputs/lens_18_measured_beam/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_18_measured_beam/light.png")
