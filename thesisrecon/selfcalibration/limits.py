"""From where on an answer of self-calibration is not determined: for the verdict and for its words."""

MAX_FOCAL_STD = 0.15
"""A focal length that is not known to this relative deviation is not known."""
MIN_SIGNIFICANCE = 4.0
"""Noise alone turns cameras that did not turn, and what it feigns looks like information: a turn counts where
it stands out of its own deviation by so much."""
MOST_NOISE = 3.0
"""Metric cameras leave this much more noise than the projective ones where they are not what was seen: a
principal point or distortion that the projective cameras took in costs less."""
