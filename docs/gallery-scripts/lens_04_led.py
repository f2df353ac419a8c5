"""
Even light from an LED
======================

A chip of 1 mm, simulated with its size, becomes an evenly lit rectangle beside the lamp; both faces reflect.
The scene file is :download:`lens_04_led.toml`:

.. literalinclude:: lens_04_led.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_04_led.toml", progress=False)
report = design.write("outputs/lens_04_led", progress=False)
design.picture("outputs/lens_04_led/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_04_led/light.png")
