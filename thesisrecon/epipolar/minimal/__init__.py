"""Section 5.2: the compiled seven-point solver of the search, many samples at a time."""
