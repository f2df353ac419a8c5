"""Writing and reading of a lens's files for a machine shop: exact faces, solid, STEP and mesh.

`mesh` does not load OCC (OpenCASCADE); the other modules do.
"""
