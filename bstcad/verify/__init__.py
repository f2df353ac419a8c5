"""Verification: the written files, measured against the design."""
