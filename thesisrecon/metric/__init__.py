"""After chapter 7: postponed cameras, metric refinement, intervals and the self-check."""
