"""Estimation: Levenberg-Marquardt, robust losses, noise (5.4) and bundle adjustment (6.7)."""
