"""From an optimised lens to the files that a machine shop opens, and back: exact faces, solid, STEP, mesh.

`mesh` does not load OCC, the others do.
"""
