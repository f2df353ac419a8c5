"""
An even line from a laser diode
===============================

A diode shines 4 times as far to the sides as up and down; its lens has the same proportions and throws an even line.
The light fades over 5 mm at the border, because a smooth face cannot form a sharp edge.
The scene file is :download:`lens_17_line.toml`:

.. literalinclude:: lens_17_line.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the screen as an eye sees it:

import bstcad

design = bstcad.design("lens_17_line.toml", progress=False)
report = design.write("outputs/lens_17_line", progress=False)
design.picture("outputs/lens_17_line/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_17_line/light.png")
