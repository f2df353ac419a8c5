"""
A QR code that a phone reads
============================

The code is an array of black and white modules. A reader decodes it from the simulated light.
The scene file is :download:`lens_10_qr.toml`:

.. literalinclude:: lens_10_qr.toml
   :language: toml
"""

# %%
# Design the lens, write its folder, prove it from the files, and save the light on the wall as an eye sees it:

import numpy as np
import zxingcpp

import bstcad

code = zxingcpp.create_barcode("https://pypi.org/project/bstcad", zxingcpp.BarcodeFormat.QRCode)
modules = np.array(code.to_image(scale=1)) / 255.0  # (rows, columns), 1 is white; dark modules get a little light
scene = bstcad.load("lens_10_qr.toml").changed({"target.image": np.kron(np.maximum(modules, 0.02), np.ones((8, 8)))})
design = bstcad.design(scene, progress=False)
report = design.write("outputs/lens_10_qr", progress=False)
picture = design.picture("outputs/lens_10_qr/wall.png")
print(report)
print("a reader reads:", zxingcpp.read_barcode(picture).text)

# %%
# The lens at work:

design.show("outputs/lens_10_qr/light.png")
