"""Comparison of two models after a similarity: camera centres, rotations, intrinsics and point clouds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy

from thesisrecon.api.models import as_sparse_model
from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.errors import UsageError, counted, in_words
from thesisrecon.geometry.conditioning import scene_frame
from thesisrecon.geometry.strata import estimate_similarity, rotation_errors_deg
from thesisrecon.records import Similarity
from thesisrecon.results import (
    THRESHOLDS,
    ModelComparison,
    PointDistances,
    RunResult,
    SparseModel,
    SparseView,
)

Model = str | Path | SparseModel | RunResult | Mapping[str, Camera]


def compare_models(a: Model, b: Model) -> ModelComparison:
    """Compare two metric models of the same images after the similarity that takes a to b.

    Parameters
    ----------
    a, b : path, RunResult, SparseModel or mapping of str to Camera
        Models; b is the reference. A path is the folder of a run, a COLMAP model, a ``cameras.json``, or a
        trajectory in TUM or KITTI format.

    Returns
    -------
    ModelComparison
        Errors of each common camera, their summary, and the distances of the points.

    Raises
    ------
    UsageError
        If a model cannot be read or there is no common camera.

    Notes
    -----
    Cameras are paired by name; if no name is common, by name without folder and suffix; if there is none
    either, a trajectory is paired by order with a model of as many cameras. The similarity needs three common
    cameras whose centres are not on one line. Intrinsics are compared at the image size in b.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, compare_models
    >>> K, size = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), (640, 480)
    >>> centres = {"1.jpg": [0.0, 0, 0], "2.jpg": [1, 0, 0], "3.jpg": [0, 1, 0]}
    >>> a = {name: Camera(K, np.eye(3), -np.array(c), size) for name, c in centres.items()}
    >>> K_b = K / [[1.01], [1.01], [1]]
    >>> b = {name: Camera(K_b, np.eye(3), -2.0 * np.array(c), size) for name, c in centres.items()}
    >>> comparison = compare_models(a, b)
    >>> round(comparison.similarity.scale, 6), comparison.focal_error_rel.round(6).tolist()
    (2.0, [0.01, 0.01, 0.01])
    >>> bool(comparison.summary["centre_error"]["max"] < 1e-12)
    True
    """
    first, second = _model(a, "first"), _model(b, "second")
    pairs = _pairs(first, second)
    left, right = [first.views[i] for i, _ in pairs], [second.views[j] for _, j in pairs]
    R, R_b = (np.array([view.R for view in views]) for views in (left, right))
    centres, centres_b = (np.array([view.centre for view in views]) for views in (left, right))
    unknown, notes = np.full(len(pairs), np.nan), list[str]()
    similarity = _similarity(centres, centres_b, notes)
    points = None
    if similarity is not None:
        first = first.transformed(similarity)
        points = _point_distances(first.X, second.X)
    intrinsics = np.array([_intrinsic_errors(*views) for views in zip(left, right, strict=True)])
    moved = unknown if similarity is None else np.linalg.norm(similarity.apply(centres) - centres_b, axis=1)
    paired, paired_b = ({pair[k] for pair in pairs} for k in (0, 1))
    return ModelComparison(
        names=tuple(view.name for view in left),
        names_b=tuple(view.name for view in right),
        centre_error=moved,
        rotation_error_deg=rotation_errors_deg(R, R_b) if len(pairs) > 1 else unknown,
        focal_error_rel=intrinsics[:, 0],
        principal_point_error_px=intrinsics[:, 1],
        similarity=similarity,
        points=points,
        only_a=tuple(name for i, name in enumerate(first.names) if i not in paired),
        only_b=tuple(name for j, name in enumerate(second.names) if j not in paired_b),
        notes=tuple(notes),
        a=first,
        b=second,
    )


def _model(model: Model, which: str) -> SparseModel:
    if isinstance(model, Mapping):
        cameras = model.items()
        model = SparseModel([SparseView(name, c.R, c.t, c.K, c.size, c.distortion) for name, c in cameras])
    if isinstance(model, str | Path | RunResult | SparseModel):
        model = as_sparse_model(model)
        if len(model.views):
            return model
    kinds = "a path, a RunResult, a SparseModel or a mapping of names to cameras, with at least one camera"
    raise UsageError(f"the {which} model of a comparison must be {kinds}; got {in_words(model)}")


def _pairs(a: SparseModel, b: SparseModel) -> list[tuple[int, int]]:
    """Pairs of cameras with the same name, in the order of a."""
    for key in (str, _stem):
        keys, keys_b = ([key(view.name) for view in model.views] for model in (a, b))
        counts, counts_b = Counter(keys), Counter(keys_b)
        place = {name: j for j, name in enumerate(keys_b) if counts_b[name] == 1}
        pairs = [(i, place[name]) for i, name in enumerate(keys) if counts[name] == 1 and name in place]
        if pairs:
            return pairs
    trajectory = any(all(view.K is None for view in model.views) for model in (a, b))
    if trajectory and len(a.views) == len(b.views):
        return [(i, i) for i in range(len(a.views))]
    names = (f"{_few(model.names)} in the {which}" for which, model in (("first", a), ("second", b)))
    raise UsageError(
        f"the models have no common camera: {' and '.join(names)}; give models of the same images, or a "
        f"trajectory of as many cameras"
    )


def _stem(name: str) -> str:
    """The name without folder and suffix; a suffix of digits belongs to a time."""
    path = Path(name)
    return path.name if path.suffix[1:].isdigit() else path.stem


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(in_words(name) for name in names[:3]) + more


def _similarity(centres: F64, centres_b: F64, notes: list[str]) -> Similarity | None:
    """The similarity of the centres; a note if there is none, or if it is uncertain."""
    if len(centres) < 3:
        known = "rotations and intrinsics are compared" if len(centres) > 1 else "intrinsics are compared"
        notes.append(
            f"{counted(len(centres), 'common camera')} cannot be aligned, at least 3 are needed; {known}"
        )
        return None
    try:
        similarity = estimate_similarity(centres, centres_b)
    except ValueError:
        notes.append(
            "the centres of the common cameras lie on one line or in one point and cannot be aligned; "
            "rotations and intrinsics are compared"
        )
        return None
    if min(_extent_across(points) for points in (centres, centres_b)) < 0.01:
        notes.append(
            "the centres of the common cameras lie almost on one line; the rotation about it is uncertain, "
            "and with it the distances of points"
        )
    return similarity


def _extent_across(points: F64) -> float:
    along, across, _ = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1]
    return float(across / along)


def _intrinsic_errors(a: SparseView, b: SparseView) -> tuple[float, float]:
    """Relative error of the focal length, and distance of the principal points in pixels of b."""
    if a.K is None or b.K is None:
        return np.nan, np.nan
    scale = np.divide(b.size, a.size) if a.size and b.size else np.ones(2)
    focal, focal_b = (np.sqrt(f[0] * f[1]) for f in (np.diag(a.K)[:2] * scale, np.diag(b.K)))
    offset = (a.K[:2, 2] + 0.5) * scale - 0.5 - b.K[:2, 2]
    return float(focal / focal_b - 1.0), float(np.linalg.norm(offset))


def _point_distances(X: F64, X_b: F64) -> PointDistances | None:
    if not (len(X) and len(X_b)):
        return None
    thresholds = np.array(THRESHOLDS) / scene_frame(X_b)[1]
    there, back = (scipy.spatial.cKDTree(to).query(of)[0] for of, to in ((X, X_b), (X_b, X)))
    within = [np.mean(distances[:, None] < thresholds, axis=0) for distances in (there, back)]
    return PointDistances(float(np.median(there)), float(np.median(back)), thresholds, *within)
