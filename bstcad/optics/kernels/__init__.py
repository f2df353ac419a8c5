"""Compiled CPU kernels (numba).  Each is a faster form of a function of optics in plain torch and is tested with it."""
