"""Compiled CPU kernels (numba).  Each is a faster form of a plain torch function of optics and is tested against it."""
