"""Section 4.2.1: corners."""
