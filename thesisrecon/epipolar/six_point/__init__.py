"""Section 3.6.3: the compiled six-point solver of three views and the search over its samples."""
