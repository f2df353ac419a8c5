"""Light from the source to the receiver: rays, flux tubes, reach, measured pictures and wavefronts."""
