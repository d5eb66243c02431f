"""Corners of one image."""

from typing import Literal, get_args

from thesisrecon.arrays import number, whole_number
from thesisrecon.config import Detector
from thesisrecon.errors import require_word
from thesisrecon.features.harris import CornerMeasure, HarrisCorners
from thesisrecon.io._images import eight_bit_images, full_image
from thesisrecon.pipeline.matching import ImageInput
from thesisrecon.records import Features
from thesisrecon.runtime._blas import one_blas_thread

Formula = Literal["noble", "harris"]


@one_blas_thread()
def detect_corners(
    image: ImageInput, *, max_corners: int = 2000, threshold_rel: float = 0.002,
    formula: Formula = "noble", detector: Detector | None = None,
) -> Features:  # fmt: skip
    """Detect the corners of Harris and Stephens in an image at full size (4.2.1).

    Maxima of det M / trace M (Noble 1988) or det M - 0.04 (trace M)^2 (Harris and Stephens 1988) with M the
    smoothed products of the grey gradient, refined to subpixels by a quadratic surface.

    Parameters
    ----------
    image : path, ndarray (H, W), (H, W, 3) or (H, W, 4), or Image
        The image.
    max_corners : int
        Largest number of corners; weaker ones within 0.4 % of the long side of a stronger one are left out.
    threshold_rel : float
        Smallest response relative to the largest.
    formula : {"noble", "harris"}
        Corner response.
    detector : Detector, optional
        Another detector, such as that of ``config.features.detector``; the other options are not used then.

    Returns
    -------
    Features
        Corners ``xy`` (N, 2) in pixels, strongest first, with ``response`` (N,) and ``scale`` (N,).

    Raises
    ------
    ValueError
        If the image or an option is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import detect_corners
    >>> image = np.zeros((60, 80), np.uint8)
    >>> image[20:40, 30:60] = 200
    >>> sorted(map(tuple, detect_corners(image).xy.round().astype(int).tolist()))  # by smoothing inside
    [(31, 21), (31, 38), (58, 21), (58, 38)]
    """
    if detector is None:
        whole_number("detect_corners", "max_corners", max_corners, 1)
        number("detect_corners", "threshold_rel", threshold_rel)
        require_word("formula", formula, get_args(Formula))
        detector = HarrisCorners(max_corners, threshold_rel, measure=CornerMeasure(formula))
    elif not callable(getattr(detector, "detect", None)):
        raise ValueError(f"detect_corners needs a Detector or None as detector; got {detector!r}")
    return detector.detect(full_image(*eight_bit_images(image)))
