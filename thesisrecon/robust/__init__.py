"""Section 5.4: the RANSAC loop, its scores and the noise scale; knows no geometry."""
