"""Sums, compilation and the choice of kernels by device: what all rooms of optics compute with."""
