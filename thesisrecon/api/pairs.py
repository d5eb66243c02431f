"""One to three images: corners, matches, fundamental matrix, homography, trifocal tensor, epipolar lines."""

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw

from thesisrecon import arrays
from thesisrecon.api.cameras import require_threshold, search_budget
from thesisrecon.arrays import F64, U8, number, whole_number
from thesisrecon.config import Detector
from thesisrecon.config.text import Config, as_config
from thesisrecon.epipolar._matches import MAX_PX
from thesisrecon.epipolar.degeneracy import FundamentalEstimate, Method
from thesisrecon.epipolar.homography import HomographyFit, fit_homography
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.refinement import wrong_match_covariance
from thesisrecon.epipolar.three_view_estimation import NO_POINTS, NO_SEGMENTS, TrifocalFit, fit_trifocal
from thesisrecon.errors import Notice, StageFailure, require_word
from thesisrecon.features.harris import CornerMeasure, HarrisCorners
from thesisrecon.geometry.homogeneous import unit_norm
from thesisrecon.geometry.two_view import clip_line, lines_of_points
from thesisrecon.io._images import eight_bit_images, full_image, read_image, read_pixels
from thesisrecon.pipeline.matching import ImageInput, match_images
from thesisrecon.records import Features, Image, TwoView
from thesisrecon.runtime._blas import one_blas_thread
from thesisrecon.runtime._executors import available_threads
from thesisrecon.runtime._precompilation import precompile


@one_blas_thread()
def match_pair(
    image1: ImageInput, image2: ImageInput, *, config: Config | None = None, seed: int = 0
) -> TwoView:
    """Match two images and estimate their fundamental matrix (4.2 and chapter 5; HZ 11.6).

    Parameters
    ----------
    image1, image2 : path, ndarray (H, W), (H, W, 3) or (H, W, 4) uint8, or Image
        The two images; transparent pixels are masked.
    config : PipelineConfig, str or path, optional
        Settings, the name of a preset, or a TOML file; None: the preset ``default``.
    seed : int
        Random seed.

    Returns
    -------
    TwoView
        Verified matches ``xy1``, ``xy2`` (N, 2) and ``F``, in pixels of the given images, also if they were
        matched at a smaller size (``config.images.max_size_px``).

    Raises
    ------
    UsageError, StageFailure
        If a file does not exist, an image cannot be read or the images do not match.

    Examples
    --------
    >>> from thesisrecon import match_pair, sample
    >>> first, second = sorted((sample("courtyard") / "images").iterdir())[:2]
    >>> pair = match_pair(first, second)
    >>> pair.F.shape, len(pair.xy1) > 60
    ((3, 3), True)
    """
    config = as_config(config)
    sources = eight_bit_images(image1, image2)
    images = [read_image(image, max_size_px=config.images.max_size_px).images[0] for image in sources]
    precompile("matches", available_threads(), lambda *_: None)
    pair = match_images(config, (images[0], images[1]), seed)
    if not pair.accepted:
        raise StageFailure(Notice("unmatched-pair"), pair.reason)
    given = (isinstance(image1, Image), isinstance(image2, Image))
    T1, T2 = (np.eye(3) if one else im.original_from_working for one, im in zip(given, images, strict=True))
    return _transformed(pair, T1, T2)


def _transformed(pair: TwoView, T1: F64, T2: F64) -> TwoView:
    """Return the pair in the pixels of resized images, ``T1`` and ``T2`` times the old ones."""
    if np.array_equal([T1, T2], [np.eye(3)] * 2):
        return pair
    back1, back2 = np.linalg.inv(T1), np.linalg.inv(T2)

    def transform(F: F64) -> F64:
        return unit_norm(back2.T @ F @ back1)

    # Noise is one number for both images: the root mean square of the two.
    scale = float(np.hypot(T1[0, 0], T2[0, 0]) / np.sqrt(2.0))
    report = pair.degeneracy
    if report is not None:
        model, error = report.competing_model, report.expected_error_px * scale
        model = None if model is None else transform(model)
        report = replace(report, competing_model=model, expected_error_px=error)
    return replace(
        pair, F=transform(pair.F), sigma_px=pair.sigma_px * scale, xy1=pair.xy1 @ T1[:2, :2] + T1[:2, 2],
        xy2=pair.xy2 @ T2[:2, :2] + T2[:2, 2], affine=pair.affine * (T2[0, 0] / T1[0, 0]), degeneracy=report,
    )  # fmt: skip


def draw_epipolar_lines(
    image1: ImageInput, image2: ImageInput, F: F64, xy1: F64, xy2: F64, *, max_lines: int = 30
) -> tuple[U8, U8]:
    """Draw the epipolar lines of matches into both images (figure 3.11).

    Parameters
    ----------
    image1, image2 : path or array_like (H, W), (H, W, 3) or (H, W, 4)
        Files, read at full size, or images.
    F, xy1, xy2 : ndarray (3, 3), (N, 2) and (N, 2)
        Fundamental matrix and matches in pixels of these images.
    max_lines : int
        Number of matches to draw, spread over all; each has one colour in both images.

    Returns
    -------
    ndarray (H, W, 3) uint8, twice
        The images, with the line F x1 and the point x2 in the second, F' x2 and x1 in the first, drawn to
        fractions of a pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import draw_epipolar_lines
    >>> F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    >>> gray = np.full((60, 80), 128, np.uint8)
    >>> left, right = draw_epipolar_lines(gray, gray, F, np.array([[40.0, 30]]), np.array([[20.0, 30]]))
    >>> left.shape, np.unique(np.nonzero((right != 128).any(axis=2))[0]).tolist()
    ((60, 80, 3), [26, 27, 28, 29, 30, 31, 32, 33, 34])
    """
    F, xy1, xy2 = arrays.checked(
        "draw_epipolar_lines", F=(F, (3, 3)), xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2))
    )
    arrays.whole_number("draw_epipolar_lines", "max_lines", max_lines, 0)
    some = np.unique(np.linspace(0, len(xy1) - 1, min(max_lines, len(xy1))).astype(np.int64))
    xy1, xy2 = xy1[some], xy2[some]
    first, second = read_pixels(image1, image2)
    return _drawn(first, lines_of_points(F.T, xy2), xy1), _drawn(second, lines_of_points(F, xy1), xy2)


def estimate_homography(
    xy1: F64, xy2: F64, *, threshold_px: float | None = 1.0, confidence: float = 0.9999,
    max_samples: int = 2_000_000, seed: int | Generator = 0,
) -> HomographyFit:  # fmt: skip
    """Estimate the homography x2 ~ H x1 of matches with outliers (section 3.6.4; HZ 4.8).

    RANSAC over samples of four, then the least Sampson distance of the inliers, which is to first order the
    maximum likelihood for Gaussian noise in both images.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 4, px.
    threshold_px : float or None
        Distance of an inlier during the search; None: all matches are inliers.
    confidence, max_samples : float, int
        Probability of a sample without outliers at which the search ends, and the largest number of samples.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from.

    Returns
    -------
    HomographyFit
        H, inliers, noise and covariance.

    Raises
    ------
    StageFailure
        If there are too few matches, no more inliers than chance explains, or they do not determine H
        (collinear points, for example).

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import estimate_homography
    >>> xy1 = np.random.default_rng(0).uniform(0, 500, (40, 2))
    >>> xy2 = 2.0 * xy1 + [30.0, 10.0]
    >>> xy2[:10] += [[70.0, -50.0]] * np.arange(1, 11)[:, None]
    >>> fit = estimate_homography(xy1, xy2)
    >>> int(fit.inliers.sum()), np.abs(fit.H / fit.H[2, 2]).round(6).tolist()
    (30, [[2.0, 0.0, 30.0], [0.0, 2.0, 10.0], [0.0, 0.0, 1.0]])
    """
    xy1, xy2 = arrays.checked("estimate_homography", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    require_threshold(threshold_px, xy1, xy2)
    budget = search_budget(confidence, max_samples)
    return fit_homography(xy1, xy2, threshold_px, budget, arrays.generator("estimate_homography", seed))


@one_blas_thread()
def estimate_trifocal(
    xy1: F64 = NO_POINTS, xy2: F64 = NO_POINTS, xy3: F64 = NO_POINTS, *, segments: F64 = NO_SEGMENTS,
    threshold_px: float | None = 1.0, loss_px: float = 1.0, confidence: float = 0.9999,
    max_samples: int = 60_000, seed: int | Generator = 0,
) -> TrifocalFit:  # fmt: skip
    """Estimate the trifocal tensor from points and lines of three views (section 3.6.3; HZ 16.4).

    Minimises Huber's loss of the distances of points to their reprojections and of segment endpoints to the
    reprojected lines: the maximum likelihood for Gaussian noise, tolerant of a few wrong matches. Points that
    contradict the epipolar geometry of a pair of views are left out first.

    Parameters
    ----------
    xy1, xy2, xy3 : array_like (N, 2)
        Matched points of the three views, px.
    segments : ndarray (3, M, 2, 2), optional
        Endpoints of matched line segments, px; the endpoints need not correspond. 4 N + 2 M >= 26.
    threshold_px : float or None
        Threshold of the fundamental matrices by which wrong points are found, from 12 points on; None: no
        search.
    loss_px : float
        Residual at which Huber's loss becomes linear.
    confidence, max_samples : float, int
        As for :func:`estimate_fundamental`.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from.

    Returns
    -------
    TrifocalFit
        Tensor, residuals, inliers, noise and covariance.

    Raises
    ------
    StageFailure
        If there are too few matches, or they do not determine the tensor, exactly or within their noise:
        points of one plane or line, pure rotation, random matches.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.camera_matrix import project
    >>> X = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 5]
    >>> K, views = np.diag([800.0, 800.0, 1.0]), ([0, 0, 0], [-1, 0.2, 0], [0.3, -1, 0.4])
    >>> points = np.stack([project(K @ np.c_[np.eye(3), t], X) for t in views])
    >>> bool(estimate_trifocal(*points).point_residuals_px.max() < 1e-6)
    True
    """
    if not arrays.number("estimate_trifocal", "loss_px", loss_px) > 0.0:
        raise ValueError(f"loss_px must be positive; got {loss_px}")
    *each, segments = arrays.checked(
        "estimate_trifocal", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)), xy3=(xy3, ("N", 2)),
        segments=(segments, (3, "M", 2, 2)),
    )  # fmt: skip
    require_threshold(threshold_px, *each)
    points = np.stack(each)
    if max(np.abs(points).max(initial=0.0), np.abs(segments).max(initial=0.0)) > MAX_PX:
        raise ValueError(f"points and segments must be pixels of an image; some are beyond {MAX_PX:g}")
    if segments.size and not (np.linalg.norm(segments[:, :, 0] - segments[:, :, 1], axis=2) > 0.0).all():
        raise ValueError("a segment needs two different ends; one has no length")
    rng = arrays.generator("estimate_trifocal", seed)
    search = _search(threshold_px, confidence, max_samples)
    return fit_trifocal(points, segments, search=search, loss_px=loss_px, rng=rng)


def _search(threshold_px: float | None, confidence: float, max_samples: int) -> LocallyOptimisedRansac | None:
    budget = search_budget(confidence, max_samples)
    return None if threshold_px is None else LocallyOptimisedRansac(threshold_px, *budget)


@one_blas_thread()
def estimate_fundamental(
    xy1: NDArray[np.float64], xy2: NDArray[np.float64], *, method: Method = "locally-optimised",
    threshold_px: float | None = 1.0, confidence: float = 0.9999, max_samples: int = 60_000,
    seed: int | Generator = 0,
) -> FundamentalEstimate:  # fmt: skip
    """Estimate the fundamental matrix of matches by one of the methods of chapter 5.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 8 (N = 7 for "seven-point"), px.
    method : str
        For matches with outliers: "locally-optimised"
        (:class:`~thesisrecon.epipolar.locally_optimised.LocallyOptimisedRansac`), "ransac" (Algorithm 2 of
        the thesis). For matches without outliers: "gold-standard" (least reprojection error, HZ 11.4.1),
        "eight-point" (normalised) or "seven-point" (up to three solutions).
    threshold_px : float or None
        Largest Sampson distance of an inlier during the search of these two. None: no outliers;
        "gold-standard" is used instead.
    confidence, max_samples : float, int
        Of "locally-optimised": probability of a sample without outliers at which the search ends, and the
        largest number of samples.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from; the same seed gives the same result.

    Returns
    -------
    FundamentalEstimate
        F with x2' F x1 = 0, inliers, noise and covariance. ``determined``: no other F explains the matches as
        well; otherwise ``reasons`` says why. The covariance is that of the minimum of the Sampson distances,
        a lower bound for the linear methods; those that search add what accepted wrong matches contribute.
        For "seven-point" noise and covariance are NaN (there are no residuals), and ``competing_models`` are
        the other solutions.

    Raises
    ------
    StageFailure
        If there are too few or collinear matches, or no F has 8 matches within the threshold.

    Examples
    --------
    >>> from thesisrecon import estimate_fundamental
    >>> from thesisrecon.testing import two_views
    >>> pair = two_views(outliers=0.3)
    >>> fit = estimate_fundamental(pair.xy1, pair.xy2)
    >>> bool(fit.inliers[pair.inlier].mean() > 0.95), fit.determined
    (True, True)
    >>> plane = 1.1 * pair.xy1 + [40.0, 10.0]
    >>> estimate_fundamental(pair.xy1, plane).determined
    False
    >>> good = fit.inliers
    >>> estimate_fundamental(pair.xy1[good], pair.xy2[good], method="eight-point").covariance.shape
    (9, 9)
    """
    xy1, xy2 = arrays.numbers("estimate_fundamental", xy1=xy1, xy2=xy2)
    require_word("method", method, get_args(Method))
    rng = arrays.generator("estimate_fundamental", seed)
    require_threshold(threshold_px, xy1, xy2)
    search = _search(threshold_px, confidence, max_samples)
    if threshold_px is None:
        threshold_px, method = 1.0, "gold-standard" if method in ("locally-optimised", "ransac") else method
    if method == "locally-optimised" and search is not None:
        fit = search.estimate(xy1, xy2, rng)
    else:
        # Imported on use: the default method does not need it.
        from thesisrecon.epipolar.ransac import ThesisRansac, fit_all, fit_seven

        if method == "seven-point":
            fit = fit_seven(xy1, xy2)
        elif method == "ransac":
            fit = ThesisRansac(threshold_px=threshold_px).estimate(xy1, xy2, rng)
        else:
            fit = fit_all(xy1, xy2, refined=method == "gold-standard")
    noise = fit.covariance
    if method in ("locally-optimised", "ransac"):
        fit = replace(fit, covariance=noise + wrong_match_covariance(fit, xy1, xy2))
    # Copies: the test is made later.
    copies: Any = {"xy1": xy1.copy(), "xy2": xy2.copy(), "noise_covariance": noise}
    return FundamentalEstimate(**vars(fit), **copies, unit_px=threshold_px)


def epipolar_lines(F: F64, xy1: F64) -> F64:
    """Return the epipolar lines l = F x1 (3.34; HZ 9.2), unit normals: l' (x, y, 1) is a distance in px.

    Parameters
    ----------
    F, xy1 : array_like (3, 3) and (N, 2)
        Fundamental matrix, or F' for the lines in image 1, and pixels.

    Returns
    -------
    ndarray (N, 3)
        Zero for an epipole.

    Examples
    --------
    >>> F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    >>> np.abs(epipolar_lines(F, np.array([[40.0, 30.0]]))).tolist()
    [[0.0, 1.0, 30.0]]
    """
    F, xy1 = arrays.checked("epipolar_lines", missing=("xy1",), F=(F, (3, 3)), xy1=(xy1, ("N", 2)))
    return lines_of_points(F, xy1)


def _drawn(image: U8, lines: F64, xy: F64) -> U8:
    """An image with lines (N, 3) and points (N, 2); number k always has the same colour."""
    height, width = image.shape[:2]
    thick, fine, strip = max(1, round(max(height, width) / 400)), 4, 256
    drawn = np.empty_like(image)
    # At four times the size, then reduced: edges are smooth and right to an eighth of a pixel.
    for top in range(0, height, strip):
        part = PillowImage.fromarray(image[top : top + strip])
        picture = part.resize((fine * part.width, fine * part.height), PillowImage.Resampling.NEAREST)
        draw, shift = ImageDraw.Draw(picture), np.array([0.0, fine * top])
        for k, (line, point) in enumerate(zip(lines, fine * xy + (fine - 1) / 2.0, strict=True)):
            # The golden ratio spreads hues evenly for any number of matches.
            colour = f"hsv({222.4922 * k % 360.0:.3f}, 100%, 100%)"
            if (ends := clip_line(line, width, height)) is not None:
                # Whole numbers are drawn alike in every strip, by an even width half a pixel farther.
                ends = np.rint(fine * np.asarray(ends) + fine / 2.0 - 1.0) - shift
                draw.line([tuple(end) for end in ends], colour, fine * thick)
            radius = 4.5 * fine * thick - 0.5
            low, high = np.rint(np.clip([point - radius, point + radius], -1e6, 1e6)) - shift
            draw.ellipse((*low, *high), outline=colour, width=fine * thick)
        drawn[top : top + strip] = np.asarray(picture.reduce(fine))
    return drawn


Formula = Literal["noble", "harris"]


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
