"""Sources of light: emitters, their profiles, rays from files, wavefronts, and channels of a spectrum."""
