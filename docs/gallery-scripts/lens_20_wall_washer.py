"""
A wall washer
=============

A lamp at the ceiling, 1 m in front of a wall, lights the wall evenly from 0.4 m to 2.4 m below the ceiling. The far end
is 2.4 times as far away as the near one.
The scene file is :download:`lens_20_wall_washer.toml`:

.. literalinclude:: lens_20_wall_washer.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_20_wall_washer.toml", progress=False)
report = design.write("outputs/lens_20_wall_washer", progress=False)
design.picture("outputs/lens_20_wall_washer/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_20_wall_washer/light.png")
