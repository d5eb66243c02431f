"""Run every stage and its references on the same inputs and report the results."""
