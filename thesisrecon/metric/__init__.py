"""After chapter 7: deferred cameras, metric refinement, intervals and the self-check."""
