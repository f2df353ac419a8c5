"""From an optimised lens to what a machine shop opens, and back: exact faces, solid, STEP, mesh.

`solid`, `step` and `faces` load OCC; `volume`, `mesh` and `part21` do not.
"""
