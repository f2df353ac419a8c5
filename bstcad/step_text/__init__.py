"""Reader of STEP files (ISO 10303-21) as text, without OCC, so that each written file is checked independently."""
