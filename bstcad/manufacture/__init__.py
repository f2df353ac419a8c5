"""What becomes of a design in a shop: measured parts, what to cut next, and errors of making."""
