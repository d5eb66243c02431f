"""Sections 5.3: the compiled refinement over matrices of rank 2."""
