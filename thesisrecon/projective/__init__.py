"""Chapter 6: projective reconstruction."""
