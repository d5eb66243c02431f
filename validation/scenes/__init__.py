"""Synthetic and real test scenes with ground truth."""
