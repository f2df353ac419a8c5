"""Optimal transport from a source density to a target density on the unit square, independent of lenses."""

from bstcad.transport.bfm import Step, Transport, back_and_forth
from bstcad.transport.density import Density
from bstcad.transport.mapping import Frame, Mapping, mass_error, solve

__all__ = ["Density", "Frame", "Mapping", "Step", "Transport", "back_and_forth", "mass_error", "solve"]
