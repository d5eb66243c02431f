"""Error measures of cameras, images and surfaces."""
