"""
A street light
==============

An LED at a height of 8 m lights 30 m x 8 m of road. The lens is a dome, which takes the light of the LED up to 89° from
its axis. The chip of 1 mm x 1 mm is simulated with its size: its image on the road is more than a metre wide.
The scene file is :download:`lens_19_street_light.toml`:

.. literalinclude:: lens_19_street_light.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the road as an eye sees it:

import bstcad

design = bstcad.design("lens_19_street_light.toml", progress=False)
report = design.write("outputs/lens_19_street_light", progress=False)
design.picture("outputs/lens_19_street_light/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_19_street_light/light.png")
