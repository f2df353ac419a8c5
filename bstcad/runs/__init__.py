"""Runs without lenses: files, processes, signals, checkpoints, progress and machines."""
