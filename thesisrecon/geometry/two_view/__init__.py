"""Two views at a time: the pencil of epipolar planes and the best pair of lines in it, compiled."""
