"""A made part: a cloud of measured points aligned with the lens, its deviation, and the light that it will throw."""
