"""Section 4.2.1: feature points."""
