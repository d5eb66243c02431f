"""Run folder, workers and signals."""
