"""Validation of thesisrecon against ground truth and reference programs."""
