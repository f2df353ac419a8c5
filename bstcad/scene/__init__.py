"""Scenes: frozen records in mm, degrees and nm, read from TOML, with their units, ranges and checks."""
