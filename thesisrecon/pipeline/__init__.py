"""Algorithm 1 of the thesis: the stages in order."""
