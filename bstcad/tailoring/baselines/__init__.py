"""Baselines of tailoring: the paper's own procedure, and integration of the map."""
