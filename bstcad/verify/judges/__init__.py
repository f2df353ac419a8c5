"""Judges: other programs that trace the lens, and their comparison with the trace of bstcad."""
