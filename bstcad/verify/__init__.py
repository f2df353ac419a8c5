"""Verification: what the written files hold, measured against what was designed."""
