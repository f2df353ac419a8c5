"""Files of a lens for a machine shop, written and read: exact faces, solid, STEP and mesh.

`mesh` does not load OCC, the other modules do.
"""
