"""Judge made parts: align a measured cloud with the lens, fit its form error, and predict the light."""
