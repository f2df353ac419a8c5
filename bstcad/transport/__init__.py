"""Optimal transport from a source density to a target density on the unit square, independent of lenses."""

from bstcad.transport.bfm import TransportStep, back_and_forth
from bstcad.transport.density import Density
from bstcad.transport.mapping import Frame, Mapping, Solver, mass_error, solve

__all__ = ["Density", "Frame", "Mapping", "Solver", "TransportStep", "back_and_forth", "mass_error", "solve"]
