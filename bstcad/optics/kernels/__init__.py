"""Compiled CPU kernels (numba).  Each stands behind a function of optics in plain torch and is tested against it."""
