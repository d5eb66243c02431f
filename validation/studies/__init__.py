"""Studies: measurements against theory and references, run by ``python -m validation study NAME``."""
