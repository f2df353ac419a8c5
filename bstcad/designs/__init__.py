"""How a lens comes about, its course, and the folder that is written whole and read back."""
