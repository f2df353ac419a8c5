"""Verification of a design: its written files are measured and compared with it."""
