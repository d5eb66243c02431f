"""Studies: measurements beside theory and references, each run by ``python -m validation study NAME``."""
