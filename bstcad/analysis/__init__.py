"""Quantities of a lens: its shape, the light through it, neglected effects and cost."""
