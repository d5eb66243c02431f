"""Chapter 3: projective geometry as pure functions of arrays."""
