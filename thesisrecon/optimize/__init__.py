"""Optimisation and robust statistics: least squares, noise, robust resection, optimal triangulation."""
