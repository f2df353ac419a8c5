"""From an optimised lens to the files that a machine shop opens, and back: exact faces, solid, STEP, mesh.

`mass_properties`, `mesh` and `mesh_files` do not load OCC, the others do.
"""
