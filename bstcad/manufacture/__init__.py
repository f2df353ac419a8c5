"""Manufacture of a design: measured parts, what to cut next, and errors of making."""
