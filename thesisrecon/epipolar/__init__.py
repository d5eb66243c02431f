"""Chapter 5: the fundamental matrix."""
