"""STEP files (ISO 10303-21) as text: a reader that shares no line with OCC, a second opinion on each written file."""
