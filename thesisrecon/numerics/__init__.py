"""Estimation: robust losses, Levenberg-Marquardt, RANSAC, noise and bundle adjustment.

======================== ==========================================================================
``levenberg_marquardt``  the damping loop of every problem, dense least squares
``losses``               robust losses
``small_solvers``        compiled solvers of small systems
``ransac``               Algorithm 2: random sample consensus
``noise``                standard deviation of residuals with wrong matches (5.4)
``observations``         image observations, sorted and checked
``projective_bundle``    projective bundle adjustment (6.7)
``metric_bundle``        metric bundle adjustment; ``metric_cameras`` projects and linearises,
                         ``intrinsic_unknowns`` numbers shared and separate intrinsics
``partial_bundle``       points with fixed cameras, one camera or pose with fixed points
``schur``                the sparse linear system; ``elimination`` eliminates the points,
                         ``reduced_solvers`` solve for the cameras
``covariance``           covariances of poses and intrinsics, noise of the residuals
``block_scatter``        contradictions between parts of the scene (cluster-robust variance)
======================== ==========================================================================
"""
