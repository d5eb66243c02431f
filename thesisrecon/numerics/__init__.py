"""Estimation: Levenberg-Marquardt, robust losses, RANSAC, noise (5.4) and bundle adjustment (6.7)."""
