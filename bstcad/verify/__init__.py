"""Verification: what the written files say of the lens, and the report that shows it."""
