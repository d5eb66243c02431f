"""Estimation: losses, Levenberg-Marquardt, bundle adjustment with its covariances, noise, RANSAC."""
