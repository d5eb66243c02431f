"""From where on an answer of self-calibration is not determined: for the verdict and for its words."""

MAX_FOCAL_STD = 0.15
"""A focal length that is not known to this relative deviation is not known."""
MIN_SIGNIFICANCE = 4.0
"""Noise alone turns cameras that did not turn, and what it feigns looks like information: a turn counts where
it stands out of its own deviation by so much."""
MOST_NOISE = 3.0
"""Metric cameras leave this much more noise than the projective ones where they are not what was seen: a
principal point or distortion that the projective cameras took in costs less."""
LEAST_MOVE = 0.003
"""Of the picture of infinity, in long sides. What no lens model holds (a raster that was resampled, a lens
that breathes) moves pictures by 1e-4 or so, alike in all parts of a scene, so that no covariance knows of it.
A turn that moves the picture by s tells the focal length by its part of second order, s (x / f)^2, about a
tenth of s: to know the focal to 15 %, 2 (s / 10) 0.15 must stand out of 1e-4."""
