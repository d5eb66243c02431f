"""New views of a model or of images (thesis, sections 1.2, 1.3 and 2.6)."""
