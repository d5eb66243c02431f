"""File input and output: images, COLMAP models, meshes, text and JSON."""
