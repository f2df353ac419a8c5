"""Files that a shop or another optical program asks for, made from the exact surfaces of a design."""
