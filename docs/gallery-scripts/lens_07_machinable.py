"""
Letters for a tool of 1 mm
==========================

No valley of this back is narrower than a tool of 1 mm radius, no place steeper than 40 degrees; the bounds hold while
the back is tailored.
The scene file is :download:`lens_07_machinable.toml`:

.. literalinclude:: lens_07_machinable.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import bstcad

design = bstcad.design("lens_07_machinable.toml", progress=False)
report = design.write("outputs/lens_07_machinable", progress=False)
design.picture("outputs/lens_07_machinable/wall.png")
print(report)

# %%
# The lens at work:

design.show("outputs/lens_07_machinable/light.png")
