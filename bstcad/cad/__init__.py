"""From an optimised lens to what a machine shop opens, and back: exact faces, solid, STEP, mesh.

`volume` and `mesh` do not load OCC, the others do.
"""
