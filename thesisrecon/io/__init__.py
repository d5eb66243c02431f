"""Files: photographs, COLMAP models, the run directory."""
