"""Paths of round tools over a tailored face, for lathes with a slow tool servo and for routers with three axes."""
