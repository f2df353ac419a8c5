"""Tolerances: errors of making, mounting and lighting, their trials, yield and pictures."""
