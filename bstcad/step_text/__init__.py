"""A reader of STEP files (ISO 10303-21) as text.  It shares no code with OCC: a second opinion on each written file."""
