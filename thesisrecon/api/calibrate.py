"""The steps of chapter 7, one function each: plane at infinity, affine frame, metric frame."""

from collections.abc import Callable, Mapping

import numpy as np

from thesisrecon.api.cameras import reconstruction_from_cameras
from thesisrecon.api.given import checked_sizes
from thesisrecon.arrays import F64, I64, checked, numbers, require_shapes, sizes_of_images
from thesisrecon.config import KINDS, PipelineConfig, SelfCalibrator
from thesisrecon.config.intrinsics import prior_for
from thesisrecon.config.text import Config, as_config
from thesisrecon.errors import Notice, StageFailure, UsageError, unknown_word
from thesisrecon.geometry.homogeneous import homogenize, pixel_from_unit
from thesisrecon.pipeline.run import stream
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.runtime._blas import one_blas_thread
from thesisrecon.selfcalibration.cheirality import CheiralitySearch, ModulusConstraint
from thesisrecon.selfcalibration.kruppa import calibrate_from_fundamentals
from thesisrecon.selfcalibration.stratified import Stratified, plane_from_vanishing_points, upgrade_to_affine

METHODS: Mapping[str, Callable[[], SelfCalibrator]] = {
    **KINDS["selfcalibration"],
    "cheirality-search": lambda: Stratified(CheiralitySearch()),
    "modulus-constraint": lambda: Stratified(ModulusConstraint()),
}
"""Methods by name; the last two are "stratified" with different methods for the plane at infinity."""


@one_blas_thread()
def self_calibrate(
    reconstruction: Reconstruction | F64, sizes: I64 | None = None, *, X: F64 | None = None,
    xy: F64 | None = None, method: str | SelfCalibrator | None = None, config: Config | None = None,
    seed: int = 0,
) -> SelfCalibration:  # fmt: skip
    """Estimate the metric frame and the intrinsics of a projective reconstruction (chapter 7).

    Parameters
    ----------
    reconstruction : Reconstruction or ndarray (V, 3, 4)
        Projective reconstruction of at least three views, or their cameras P alone.
    sizes : array_like (V, 2) or (2,)
        Image width and height, for plain P.
    X, xy : ndarray (N, 3) or (N, 4), ndarray (V, N, 2), optional
        Points and their pixels for plain P, as in :func:`thesisrecon.reconstruction_from_cameras`. Without
        them the world may be mirrored, and noise is not considered.
    method : str or SelfCalibrator, optional
        "hypotheses-and-refinement", "nonlinear-quadric", "linear-quadric", "kruppa-equations", "stratified";
        "cheirality-search" or "modulus-constraint", which are "stratified" with this method for the plane at
        infinity; or a method object. None: ``config.selfcalibration``.
    config : PipelineConfig, str or path, optional
        ``config.intrinsics`` is the prior knowledge; by default images of the same size share one camera.
    seed : int
        Random seed.

    Returns
    -------
    SelfCalibration
        ``metric_from_projective`` (4, 4), ``K`` (V, 3, 3) with standard deviations, the absolute dual quadric
        ``Q`` (4, 4), and all candidates.

    Raises
    ------
    ValueError, StageFailure
        If the reconstruction is not projective, the method is unknown or the seed is invalid; if no
        calibration is determined.

    Notes
    -----
    The methods solve P Q P' ~ K K' (HZ 19.3; Pollefeys, Koch and Van Gool, IJCV 32, 1999), Kruppa's equations
    (HZ 19.4), or first the plane at infinity (HZ 19.5).

    Examples
    --------
    Seven cameras of one focal length in a projective frame:

    >>> import numpy as np
    >>> from thesisrecon import reconstruction_from_cameras, sample, self_calibrate
    >>> cube = np.load(sample("cube") / "cube.npz")
    >>> Rt = np.concatenate([cube["R"], -cube["R"] @ cube["C"][:, :, None]], axis=2)[::4]
    >>> P = cube["K"] @ Rt @ np.random.default_rng(1).normal(size=(4, 4))
    >>> size, xy = (823, 581), cube["xy"][::4]
    >>> projective = reconstruction_from_cameras(P, sizes=size, xy=xy, stratum="projective")
    >>> round(self_calibrate(projective).K[0, 0, 0])
    842
    >>> round(self_calibrate(P, size, method="nonlinear-quadric").K[0, 0, 0])
    842
    """
    projective = _projective("self_calibrate", reconstruction, sizes, X, xy)
    calibrator, settings = _method(projective, method, config)
    prior = prior_for(projective, settings.intrinsics)
    return calibrator.calibrate(projective, prior=prior, rng=stream(seed, "selfcalibration"))


def plane_at_infinity(
    reconstruction: Reconstruction | F64, sizes: I64 | None = None, *, X: F64 | None = None,
    xy: F64 | None = None, config: Config | None = None, seed: int = 0,
    vanishing_points: F64 | None = None, method: str | SelfCalibrator | None = None,
) -> F64:  # fmt: skip
    """Locate the plane at infinity of a projective frame (chapter 7, stratified; HZ 10.4.1 and 19.5).

    Parameters
    ----------
    reconstruction, sizes, X, xy, config, seed
        As for :func:`self_calibrate`; two views are enough with vanishing points.
    vanishing_points : ndarray (V, D, 2) or (V, D, 3), optional
        Pixels of the vanishing points of D >= 3 directions, each seen in at least two views, NaN where not;
        homogeneous for points at infinity of the image.
    method : str or SelfCalibrator, optional
        As for :func:`self_calibrate`. "stratified" locates the plane only; the others calibrate as well.

    Returns
    -------
    ndarray (4,)
        Plane of unit norm, pi'X = 0 for points X at infinity.

    Raises
    ------
    ValueError, StageFailure
        As :func:`self_calibrate`; if the directions do not determine the plane.

    Examples
    --------
    The vanishing points of the axes in two metric cameras; their plane at infinity is (0, 0, 0, 1):

    >>> import numpy as np
    >>> from thesisrecon import plane_at_infinity
    >>> K, turn = np.diag([800.0, 800, 1]), np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    >>> P = K @ np.stack([np.c_[turn, [0, 0, 5.0]], np.c_[turn.T, [1.0, 0, 6]]])
    >>> v = P[:, :, :3].transpose(0, 2, 1)
    >>> np.abs(plane_at_infinity(P, (640, 480), vanishing_points=v)).round(6).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    projective = _projective("plane_at_infinity", reconstruction, sizes, X, xy)
    if vanishing_points is None:
        calibrator, settings = _method(projective, method, config)
        prior, rng = prior_for(projective, settings.intrinsics), stream(seed, "selfcalibration")
        if isinstance(calibrator, Stratified):
            return calibrator.locate(projective, prior=prior, rng=rng)
        return calibrator.calibrate(projective, prior=prior, rng=rng).plane_at_infinity
    (v,) = numbers("plane_at_infinity", missing=("vanishing_points",), vanishing_points=vanishing_points)
    v = homogenize(v) if v.shape[-1:] == (2,) else v
    require_shapes("plane_at_infinity", P=(projective.P, ("V", 3, 4)), vanishing_points=(v, ("V", "D", 3)))
    seen = projective.registered
    return plane_from_vanishing_points(projective.P[seen], v[seen], pixel_from_unit(projective.sizes)[seen])


def upgrade_affine(
    reconstruction: Reconstruction, plane: F64 | None = None, *, config: Config | None = None, seed: int = 0
) -> Reconstruction:
    """Upgrade a projective reconstruction to an affine one: P G^-1, G X (3.4.3, chapter 7; HZ 10.4.1).

    Parallel lines and ratios of lengths along them are then those of the scene.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    plane : ndarray (4,), optional
        Plane at infinity in the projective frame; None: located by :func:`plane_at_infinity`.
    config, seed
        As for :func:`self_calibrate`.

    Returns
    -------
    Reconstruction
        The same cameras and points in an affine frame.

    Raises
    ------
    ValueError, StageFailure
        If the reconstruction is not projective, the plane is zero or not finite, or the seed is invalid; if
        the plane at infinity cannot be located.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import reconstruction_from_cameras, upgrade_affine
    >>> P, X = np.eye(3, 4)[None], np.array([[1.0, 2, 4, 3], [0, 1, 2, 1]])
    >>> projective = reconstruction_from_cameras(P, sizes=(640, 480), X=X, stratum="projective")
    >>> affine = upgrade_affine(projective, plane=np.array([0.0, 0, 0.5, 0]))
    >>> affine.stratum, bool((affine.X[:, 3] == 1).all())
    ('affine', True)
    """
    projective = _projective("upgrade_affine", reconstruction, None, None, None)
    if plane is None:
        plane = plane_at_infinity(projective, config=config, seed=seed)
    return upgrade_to_affine(projective, numbers("upgrade_affine", plane=plane)[0])


def _projective(
    caller: str, given: Reconstruction | F64, sizes: I64 | None, X: F64 | None, xy: F64 | None
) -> Reconstruction:
    """The projective reconstruction that was given, or that of plain cameras."""
    if not isinstance(given, Reconstruction):
        if sizes is None:
            raise ValueError(Notice("cameras-without-sizes", caller))
        try:
            return reconstruction_from_cameras(given, sizes=sizes, X=X, xy=xy, stratum="projective")
        except ValueError as error:
            # The message names the call that was made.
            raise ValueError(str(error).replace("reconstruction_from_cameras", caller)) from None
    if given.stratum == "projective":
        return given
    if given.stratum == "metric":
        raise ValueError(Notice("no-projective-but-metric", caller))
    raise ValueError(Notice("no-projective-but-affine", caller))


def _method(
    projective: Reconstruction, method: str | SelfCalibrator | None, config: Config | None
) -> tuple[SelfCalibrator, PipelineConfig]:
    settings = as_config(config)
    if isinstance(method, str):
        if method not in METHODS:
            raise UsageError(unknown_word("method", method, METHODS))
        method = METHODS[method]()
    method = method or settings.selfcalibration
    if isinstance(method, Stratified) and not projective.inlier.any():
        raise StageFailure.of("plane-without-points")
    return method, settings


def kruppa(F: F64, sizes: I64) -> F64:
    """Calibrate one constant camera from fundamental matrices alone, by the Kruppa equations (section 7.3).

    Square pixels without skew and a principal point within about 1 % of the image centre are assumed. F is
    normalised first; :class:`KruppaEquations` also allows different cameras.

    Parameters
    ----------
    F : ndarray (M, 3, 3) or (3, 3)
        Fundamental matrices of M pairs of images of the camera, px.
    sizes : array_like (2,) or (V, 2)
        Width and height of the images, all equal.

    Returns
    -------
    ndarray (3, 3)
        K in pixels.

    Raises
    ------
    StageFailure
        If the equations do not determine the focal length, or have several solutions.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import kruppa, sample
    >>> from thesisrecon.geometry.two_view import fundamental_from_cameras
    >>> cube = np.load(sample("cube") / "cube.npz")
    >>> P = cube["K"] @ np.concatenate([cube["R"], -cube["R"] @ cube["C"][:, :, None]], axis=2)[::4]
    >>> F = np.stack([fundamental_from_cameras(P[i], P[j]) for i, j in ((0, 1), (0, 2), (1, 2))])
    >>> round(float(kruppa(F, (823, 581))[0, 0]), 3)
    842.0
    """
    (F,) = numbers("kruppa", F=F)
    (F,) = checked("kruppa", F=(F[None] if F.ndim == 2 else F, ("M", 3, 3)))
    given = np.atleast_2d(numbers("kruppa", sizes=sizes_of_images(sizes))[0])
    if given.ndim != 2 or given.shape[1] != 2 or len(np.unique(given, axis=0)) != 1:
        raise ValueError(f"kruppa needs images of the same size, width and height; got {given.tolist()}")
    return calibrate_from_fundamentals(F, checked_sizes("kruppa", given, len(given))[:1])
