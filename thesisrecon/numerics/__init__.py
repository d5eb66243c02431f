"""Optimisation and robust statistics."""
