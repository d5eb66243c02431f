"""Levenberg-Marquardt and sparse bundle adjustment."""
