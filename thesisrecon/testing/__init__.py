"""Accuracy gates for pytest: cameras, fundamental matrices and clouds against the truth.

The plugin of pytest (``pytest_plugins = ["thesisrecon.testing.plugin"]`` in conftest.py) has the fixtures
``thesisrecon_courtyard`` and ``thesisrecon_two_views``, the marker ``accuracy_gate``, and a line of the
summary for each assertion with the smallest error that it would have seen. Errors are held against stated
standard deviations where there are some (a run, :attr:`thesisrecon.Camera.std`, a covariance), else against
limits of your own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from thesisrecon.arrays import B8, F64
    from thesisrecon.camera import Camera

# Loaded before anything else by pytest: numpy and the library are imported on use.
POWER = 1.645
"""Standard deviations beyond a limit at which an error is seen in 95 of 100 cases."""
_SEEN: list[str] = []
_PARTS = (
    *("focal_px", "principal_x_px", "principal_y_px"),
    *(f"rotation_{axis}_deg" for axis in "xyz"),
    *(f"centre_{axis}" for axis in "xyz"),
)
"""Names in ``Camera.std`` of the columns of :class:`CameraDeviations`."""


class CameraDeviations(NamedTuple):
    """Errors of cameras by name after alignment, and in stated standard deviations, NaN where none is stated.

    ``focal_pct``, ``rotation_deg`` and ``centre`` (units of the truth) are sizes; ``z`` (V, 9) holds the
    focal length, the principal point, the rotation about the camera's axes and the centre along the world's;
    ``std`` (V, 9) what they were divided by, in per cent, px, degrees and units of the truth.
    """

    names: tuple[str, ...]
    missing: tuple[str, ...]
    focal_pct: F64
    rotation_deg: F64
    centre: F64
    z: F64
    std: F64


def camera_deviations(model: Any, truth: Any) -> CameraDeviations:
    """Compare two models of the same images, camera by camera.

    Parameters
    ----------
    model, truth : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera
        Anything with metric cameras; ``model`` is what is judged.

    Returns
    -------
    CameraDeviations
        Errors in the inner gauge: without the similarity that moves the cameras least, which the stated
        standard deviations do not contain either (Triggs et al. 2000, 9.5).

    Raises
    ------
    UsageError
        If a model cannot be read or there is no common camera.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import replace
    >>> from thesisrecon.testing import camera_deviations, courtyard
    >>> _, truth = courtyard()
    >>> K = np.diag([1.01, 1.01, 1.0])
    >>> found = {n: replace(c, K=K @ c.K, std={"focal_px": 8.0}) for n, c in truth.items()}
    >>> errors = camera_deviations(found, truth)
    >>> errors.focal_pct.round(6).tolist()[:2], errors.z[:2, 0].round(2).tolist()
    ([1.0, 1.0], [1.14, 1.14])
    """
    import numpy as np

    from thesisrecon.api.given import as_sparse_model
    from thesisrecon.api.models import compare_models

    judged = as_sparse_model(model, "the model to judge")
    found = compare_models(judged, truth)
    own, true = ({view.name: view for view in some.views} for some in (judged, found.b))
    views, truths = [own[name] for name in found.names], [true[name] for name in found.names_b]
    poses = [
        np.array([getattr(v, part) for v in some]) for some in (views, truths) for part in ("R", "centre")
    ]
    scale = 1.0 if found.similarity is None else found.similarity.scale
    values = np.full((len(views), 9), np.nan)
    R, C, R_true, C_true = poses
    values[:, 3:] = pose_errors(R, C, R_true, C_true, judged.X)
    values[:, 3:6], values[:, 6:] = np.degrees(values[:, 3:6]), scale * values[:, 6:]
    std = np.full_like(values, np.nan)
    for i, (view, other) in enumerate(zip(views, truths, strict=True)):
        if view.K is None or other.K is None:
            continue
        f, f_true = (float(np.sqrt(K[0, 0] * K[1, 1])) for K in (view.K, other.K))
        values[i, :3] = 100.0 * (f / f_true - 1.0), *(view.K[:2, 2] - other.K[:2, 2])
        units = [100.0 / f_true, 1.0, 1.0, 1.0, 1.0, 1.0, scale, scale, scale]
        std[i] = [unit * (view.std or {}).get(name, np.nan) for name, unit in zip(_PARTS, units, strict=True)]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(std > 0.0, values / std, np.nan)
    sizes = np.abs(values[:, 0]), found.rotation_error_deg, found.centre_error
    return CameraDeviations(found.names, found.only_b, *sizes, z, std)


def pose_errors(R: F64, C: F64, R_true: F64, C_true: F64, X: F64) -> F64:
    """Errors (V, 6) of poses in the inner gauge, which their stated standard deviations are in.

    They are rotations about the axes of each camera (rad), and centres along those of the world of R (world
    to camera) and C. The truth is in another world: the similarity that fits best is taken off, then the
    motion of all cameras as one that remains to first order (Triggs et al. 2000, 9.5). The middle and size of
    the points X (N, 3), or of C, weight rotations against centres.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from thesisrecon.geometry.homogeneous import scene_frame
    from thesisrecon.geometry.strata import nearest_rotation
    from thesisrecon.optimize.bundle.covariance import gauge_directions

    origin, scale = scene_frame(X if len(X) else C)
    t = -np.einsum("vab,vb->va", R, scale * (C - origin))
    centres = -np.einsum("vba,vb->va", R, t)
    Q = nearest_rotation(np.einsum("vab,vac->bc", R_true, R))
    moved = C_true @ Q
    moved = moved - moved.mean(axis=0)
    middle = centres.mean(axis=0)
    moved = middle + moved * (np.sum(moved * (centres - middle)) / max(np.sum(moved**2), 1e-300))
    turned = Rotation.from_matrix(R_true @ Q @ np.swapaxes(R, 1, 2)).as_rotvec()
    error = np.concatenate([turned, -np.einsum("vab,vb->va", R, moved - centres)], axis=1)
    N = gauge_directions(np.asarray(R, dtype=np.float64), t)
    error -= (N @ (N.T @ error.ravel())).reshape(error.shape)
    error[:, 3:] = -np.einsum("vba,vb->va", R, error[:, 3:]) / scale
    return np.asarray(error)


def assert_cameras(
    model: Any, truth: Any, *, max_sigmas: float | None = 4.0, max_focal_error_pct: float | None = None,
    max_rotation_error_deg: float | None = None, max_centre_error: float | None = None,
    sees: Mapping[str, float] | None = None,
) -> CameraDeviations:  # fmt: skip
    """Fail unless all cameras of the truth are there, within stated deviations and within given limits.

    Parameters
    ----------
    model, truth : as in :func:`camera_deviations`
    max_sigmas : float, optional
        Largest error of a focal length, principal point, rotation or centre in its stated standard deviation.
        None: stated deviations are not used. Without stated ones a limit of the next three is needed.
    max_focal_error_pct, max_rotation_error_deg, max_centre_error : float, optional
        Largest error of any camera, the centre in units of the truth.
    sees : mapping of str to float, optional
        Errors that this gate is there to see, such as ``{"focal_pct": 0.1}``; also ``rotation_deg``,
        ``centre`` and ``principal_px``. It fails if a smaller one would pass in more than 5 of 100 cases.

    Returns
    -------
    CameraDeviations

    Raises
    ------
    AssertionError
        Which error exceeds which limit; or that the gate would not see an error of ``sees``.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from thesisrecon.testing import assert_cameras, courtyard
    >>> _, truth = courtyard()
    >>> found = {n: replace(c, K=c.K * [[1.01], [1.01], [1]]) for n, c in truth.items()}
    >>> errors = assert_cameras(found, truth, max_focal_error_pct=2.0)
    >>> assert_cameras(found, truth, max_focal_error_pct=0.5)
    Traceback (most recent call last):
    AssertionError: focal_pct of 0000.jpg is 1, the limit is 0.5
    """
    import numpy as np

    errors, wrong, visible = camera_deviations(model, truth), list[str](), dict[str, float]()
    limits = {
        "focal_pct": max_focal_error_pct,
        "rotation_deg": max_rotation_error_deg,
        "centre": max_centre_error,
    }
    if errors.missing:
        wrong.append(f"{len(errors.missing)} cameras of the truth are missing, such as {errors.missing[0]}")
    for name, limit in limits.items():
        values = getattr(errors, name)
        if limit is None:
            continue
        visible[name] = limit
        worst = int(np.argmax(np.where(np.isfinite(values), values, np.inf)))
        if not values[worst] <= limit:
            wrong.append(f"{name} of {errors.names[worst]} is {values[worst]:.4g}, the limit is {limit:g}")
    stated = np.isfinite(errors.z)
    if max_sigmas is not None and stated.any():
        visible |= _visible(errors.std, max_sigmas, visible)
        size = np.where(stated, np.abs(errors.z), -1.0)
        view, part = np.unravel_index(int(np.argmax(size)), size.shape)
        if size[view, part] > max_sigmas:
            off = f"{size[view, part]:.2g} standard deviations off, the limit is {max_sigmas:g}"
            wrong.append(f"{_PARTS[part]} of {errors.names[view]} is {off}")
    if not visible:
        raise AssertionError("no deviation is stated and no limit is given: this gate sees nothing")
    _judge("cameras", wrong, visible, sees)
    return errors


def _visible(std: F64, max_sigmas: float, limits: Mapping[str, float]) -> dict[str, float]:
    """Errors that a limit in deviations sees in 95 of 100 cases, in the median camera, or those of limits."""
    import numpy as np

    found = {}
    for name, columns in {
        "focal_pct": [0],
        "principal_px": [1, 2],
        "rotation_deg": [3, 4, 5],
        "centre": [6, 7, 8],
    }.items():
        known = std[:, columns][std[:, columns] > 0.0]
        if len(known):
            error = (max_sigmas + POWER) * float(np.median(known))
            found[name] = min(error, limits.get(name, error))
    return found


def assert_fundamental(
    found: Any, truth: Any, *, false_alarm: float = 1e-4, max_px: float | None = None
) -> float:
    """Fail unless a fundamental matrix is the true one within its covariance, or within a distance.

    Parameters
    ----------
    found : (3, 3), or an estimate with F and covariance (9, 9)
        As of :func:`thesisrecon.estimate_fundamental`.
    truth : (3, 3) or (M, 4)
        The true F; or true correspondences x1, y1, x2, y2, which also need ``max_px``.
    false_alarm : float
        Share of right estimates that fail: d' C+ d of the difference d of the entries is chi-squared with 7
        degrees of freedom.
    max_px : float, optional
        Largest RMS distance of true correspondences from their epipolar lines, as in (5.6).

    Returns
    -------
    float
        The distance in px, or the root of d' C+ d / 7: about 1 if the covariance is right.

    Raises
    ------
    AssertionError, ValueError
        The matrix is off; the truth has another shape, or nothing says how far it may be off.

    Examples
    --------
    >>> from thesisrecon.testing import assert_fundamental, two_views
    >>> pair = two_views(noise_px=0.0)
    >>> round(assert_fundamental(pair.F, pair.true_matches, max_px=1e-6), 6)
    0.0
    """
    import numpy as np
    from scipy import stats

    from thesisrecon.geometry.two_view import epipolar_distances

    F, true = np.asarray(getattr(found, "F", found), dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if F.shape != (3, 3) or (true.shape != (3, 3) and (true.ndim != 2 or true.shape[1] != 4)):
        raise ValueError(
            f"assert_fundamental needs F (3, 3) and a truth (3, 3) or (M, 4); got {F.shape}, {true.shape}"
        )
    if true.shape != (3, 3):
        if max_px is None:
            raise ValueError("assert_fundamental needs max_px for true correspondences")
        distance = float(np.sqrt(np.mean(epipolar_distances(F, true[:, :2], true[:, 2:]) ** 2)))
        wrong = [f"true correspondences are {distance:.4g} px from their lines, the limit is {max_px:g}"]
        _judge("F", wrong if not distance <= max_px else [], {"distance_px": max_px})
        return distance
    covariance = getattr(found, "covariance", None)
    if covariance is None:
        raise ValueError(
            "assert_fundamental needs an estimate with a covariance, or true correspondences and max_px"
        )
    F, true = F / np.linalg.norm(F), true / np.linalg.norm(true)
    d = (F - np.sign(np.sum(F * true)) * true).ravel()
    # The scale of F and det F = 0 leave seven directions.
    values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    square = float(np.sum((vectors[:, 2:].T @ d) ** 2 / np.maximum(values[2:], 1e-300)))
    limit = float(stats.chi2.isf(false_alarm, 7))
    size, most = float(np.sqrt(square / 7.0)), float(np.sqrt(limit / 7.0))
    wrong = [f"F is {size:.3g} stated standard deviations off, the limit is {most:.3g}"]
    _judge("F", [] if square <= limit else wrong, {"deviations": _visible_deviation(limit)})
    return size


def _visible_deviation(limit: float) -> float:
    """Root mean deviation that a limit of chi-squared with 7 degrees of freedom sees in 95 of 100 cases."""
    from scipy import optimize, stats

    found = optimize.brentq(lambda square: stats.ncx2.sf(limit, 7, square) - 0.95, 1e-3, 1e4)
    return float((found / 7.0) ** 0.5)


def assert_cloud(
    points: Any, truth: Any, *, max_accuracy: float, max_completeness: float | None = None,
    quantile: float = 0.5,
) -> tuple[float, float]:  # fmt: skip
    """Fail unless two clouds of one frame agree, from each point to the nearest one of the other.

    Parameters
    ----------
    points, truth : (N, 3), (M, 3)
        Align them first, as with :func:`thesisrecon.align_to_positions`.
    max_accuracy : float
        Largest quantile of the distances from ``points`` to the truth.
    max_completeness : float, optional
        The same from the truth to ``points``.
    quantile : float
        0.5 is the median.

    Returns
    -------
    float, float
        Accuracy and completeness, in units of the clouds.

    Raises
    ------
    AssertionError
        A limit is exceeded.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.testing import assert_cloud
    >>> X = np.random.default_rng(0).normal(size=(50, 3))
    >>> assert_cloud(X[:25], X, max_accuracy=1e-9)[0]
    0.0
    """
    import numpy as np
    from scipy.spatial import KDTree

    from thesisrecon.arrays import checked

    X, Y = checked("assert_cloud", points=(points, ("N", 3)), truth=(truth, ("M", 3)))
    there, back = (
        float(np.quantile(KDTree(b).query(a)[0], quantile)) if len(a) and len(b) else float("inf")
        for a, b in ((X, Y), (Y, X))
    )
    limits = {"accuracy": (there, max_accuracy), "completeness": (back, max_completeness)}
    wrong = [
        f"{name} is {value:.4g}, the limit is {limit:g}"
        for name, (value, limit) in limits.items()
        if limit is not None and not value <= limit
    ]
    visible = {name: limit for name, (_, limit) in limits.items() if limit is not None}
    _judge("cloud", wrong, visible)
    return there, back


def _judge(
    what: str, wrong: list[str], visible: Mapping[str, float], sees: Mapping[str, float] | None = None
) -> None:
    """Note what an assertion sees; raise it if something is wrong or an error of ``sees`` would pass."""
    text = ", ".join(f"{value:.2g} of {name}" for name, value in visible.items())
    _SEEN.append(f"{what}: sees {text}")
    for name, wanted in (sees or {}).items():
        if name not in visible:
            raise ValueError(f"this gate measures {', '.join(visible)}; it cannot see {name!r}")
        if visible[name] > wanted:
            seen = f"this gate sees {visible[name]:.2g} of {name} in 95 of 100 cases, and should {wanted:g}"
            wrong = [*wrong, seen]
    if wrong:
        raise AssertionError("; ".join(wrong))


class TwoViews(NamedTuple):
    """Points in two views with known cameras; ``xy1`` and ``xy2`` (N, 2) have noise and wrong matches."""

    xy1: F64
    xy2: F64
    true_matches: F64  #: (N, 4) of the same points without noise
    inlier: B8  #: (N,) whether a match is right
    F: F64
    cameras: tuple[Camera, Camera]


def two_views(points: int = 200, *, noise_px: float = 0.5, outliers: float = 0.0, seed: int = 0) -> TwoViews:
    """Return matches of a simulated scene before two cameras that converge.

    Parameters
    ----------
    points : int
        Number of matches.
    noise_px : float
        Standard deviation of each image coordinate.
    outliers : float
        Share of matches that are drawn at random.
    seed : int
        Of the scene, the noise and the wrong matches.

    Returns
    -------
    TwoViews

    Examples
    --------
    >>> from thesisrecon.testing import two_views
    >>> two_views(50).xy1.shape
    (50, 2)
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from thesisrecon.camera import Camera
    from thesisrecon.geometry.two_view import fundamental_from_cameras

    rng = np.random.default_rng([seed, 52])
    K, size = np.array([[900.0, 0, 479.5], [0, 900.0, 359.5], [0, 0, 1]]), (960, 720)
    R = Rotation.from_rotvec([0.05, -0.35, 0.1]).as_matrix()
    first = Camera(K, np.eye(3), np.zeros(3), size)
    second = Camera(K, R, -R @ np.array([2.0, 0.2, 0.3]), size)
    X = rng.uniform([-1.5, -1.2, 4.5], [1.9, 1.2, 7.5], (points, 3))
    true = np.concatenate([camera.project(X) for camera in (first, second)], axis=1)
    xy = true + noise_px * rng.normal(size=true.shape)
    wrong = rng.random(points) < outliers
    xy[wrong, 2:] = rng.uniform([0, 0], size, (int(wrong.sum()), 2))
    F = fundamental_from_cameras(*(camera.P for camera in (first, second)))
    return TwoViews(xy[:, :2], xy[:, 2:], true, ~wrong, F / np.linalg.norm(F), (first, second))


def courtyard() -> tuple[list[Path], dict[str, Camera]]:
    """Return six rendered images of a courtyard, which the package brings, and their true cameras by name.

    Examples
    --------
    >>> from thesisrecon.testing import courtyard
    >>> images, cameras = courtyard()
    >>> len(images), all(path.name in cameras for path in images)
    (6, True)
    """
    from thesisrecon.api.models import read_cameras
    from thesisrecon.io._images import demo_images

    images = demo_images()
    cameras = read_cameras(images[0].parents[1] / "cameras.json")
    return images, {path.name: cameras[path.name] for path in images}
