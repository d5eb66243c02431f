"""Bundle adjustment (6.7): metric and projective, by the Schur complement, with covariances."""
