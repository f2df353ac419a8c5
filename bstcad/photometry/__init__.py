"""Photometric files of lamps and luminaires: intensities over directions, and rays."""
