"""Verification of a design: the written files are measured and compared with the design."""
