"""Averages of relative poses over all pairs of images: of rotations, then of directions between cameras."""

from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64, checked, numbers, require_rotations, whole_numbers

_ROUNDS, _SMALLEST = 50, 1e-6
"""Number of reweighted solutions, and the residual, rad, below which all weights are the same."""


class AveragedRotations(NamedTuple):
    """Rotations in the frame of the first camera, and how the relative ones agree with them."""

    R: F64  #: (V, 3, 3) world to camera; NaN for cameras that no pair connects with the first one
    residual_deg: F64  #: (E,) angle between a relative rotation and that of the average
    weight: F64  #: (E,) from 1, agreement, to 0, an outlier


class AveragedCentres(NamedTuple):
    """Camera centres, their mean at 0 and their RMS distance from it 1, and how the directions agree."""

    centres: F64  #: (V, 3); NaN for cameras that no pair connects with the first one
    residual_deg: F64  #: (E,) angle between a direction and that of the average
    weight: F64  #: (E,) from 1, agreement, to 0, an outlier


def average_rotations(pairs: I64, R: F64, *, weights: F64 | None = None) -> AveragedRotations:
    """Average relative rotations over all pairs of images (Hartley, Trumpf, Dai and Li, IJCV 103, 2013).

    Minimises the sum of the angles, then a redescending loss whose width follows the residuals, by
    iteratively reweighted least squares in the Lie algebra (Chatterjee and Govindu, ICCV 2013): wrong
    relative rotations have no influence.

    Parameters
    ----------
    pairs : array_like (E, 2) of int
        Cameras i and j of each relative rotation.
    R : array_like (E, 3, 3)
        Relative rotations, R_j R_i': they take directions in the frame of camera i to that of camera j.
    weights : array_like (E,), optional
        Positive weights, such as numbers of matches.

    Returns
    -------
    AveragedRotations
        Rotations of all cameras and residuals of all pairs.

    Raises
    ------
    ValueError
        If the arrays do not fit together, a matrix is no rotation, or a pair joins a camera with itself.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import average_rotations
    >>> true = Rotation.from_euler("y", [[0], [20], [40], [60]], degrees=True)
    >>> i, j = np.array(pairs := [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3), (0, 3)]).T
    >>> relative = (true[j] * true[i].inv()).as_matrix()
    >>> relative[5] = Rotation.from_euler("x", 50, degrees=True).as_matrix()
    >>> found = average_rotations(pairs, relative)
    >>> Rotation.from_matrix(found.R).magnitude().round(3).tolist()
    [0.0, 0.349, 0.698, 1.047]
    """
    caller = "average_rotations"
    i, j, given, known = _graph(caller, pairs, weights)
    (R,) = checked(caller, R=(R, (len(i), 3, 3)))
    require_rotations(caller, R)
    relative, n = scipy.spatial.transform.Rotation.from_matrix(R).as_matrix(), len(known)
    average = _along_tree(i, j, relative, given, n)
    use = known[i]
    a, b, relative, given = i[use], j[use], relative[use], given[use]

    def errors() -> F64:
        # R_ij R_i = R_j exp(e): e is to first order the difference of the steps of j and i in the world.
        turned = np.swapaxes(average[b], 1, 2) @ relative @ average[a]
        return np.asarray(scipy.spatial.transform.Rotation.from_matrix(turned).as_rotvec())

    free, D = _differences(a, b, known)
    for k in range(_ROUNDS):
        e = errors()
        w = given * _loss_weights(np.linalg.norm(e, axis=1), k)
        step = np.zeros((n, 3))
        step[free] = _solve(D, w, w[:, None] * e)
        average = average @ scipy.spatial.transform.Rotation.from_rotvec(step).as_matrix()
        if k > _ROUNDS // 2 and np.abs(step).max(initial=0.0) < 1e-10:
            break
    angle = np.linalg.norm(errors(), axis=1)
    agreement = _of_all_pairs(use, angle, _loss_weights(angle, _ROUNDS))
    return AveragedRotations(np.where(known[:, None, None], average, np.nan), *agreement)


def average_translations(pairs: I64, t: F64, R: F64, *, weights: F64 | None = None) -> AveragedCentres:
    """Compute camera centres from the directions between pairs of them.

    The sum of the distances between baselines and given directions of lengths of at least 1 is convex
    (Ozyesil and Singer, CVPR 2015). From its minimum on, the sines of the angles are minimised with a
    redescending loss (as by Zhuang, Cheong and Lee, CVPR 2018), by iteratively reweighted least squares:
    wrong directions have no influence. Centres on one line have no unique solution.

    Parameters
    ----------
    pairs : array_like (E, 2) of int
        Cameras i and j of each direction.
    t : array_like (E, 3)
        Relative translations of any length, x_j = R_ij x_i + t, such as those of an essential matrix.
    R : array_like (V, 3, 3)
        Rotations of the cameras, world to camera, such as those of :func:`thesisrecon.average_rotations`.
    weights : array_like (E,), optional
        Positive weights, such as numbers of matches.

    Returns
    -------
    AveragedCentres
        Centres of all cameras and residuals of all pairs.

    Raises
    ------
    ValueError
        If the arrays do not fit together, a matrix is no rotation, or a translation is zero.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import average_translations
    >>> C = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0, 3.0]])
    >>> i, j = np.array(pairs := [(a, b) for b in range(5) for a in range(b)]).T
    >>> found = average_translations(pairs, C[i] - C[j], np.tile(np.eye(3), (5, 1, 1)))
    >>> length = np.linalg.norm(found.centres[1] - found.centres[0])
    >>> ((found.centres - found.centres[0]) / length * 2.0).round(6).tolist()[4]
    [1.0, 0.0, 3.0]
    """
    caller = "average_translations"
    i, j, given, known = _graph(caller, pairs, weights)
    t, R = checked(caller, missing=("R",), t=(t, (len(i), 3)), R=(R, ("V", 3, 3)))
    if len(R) < len(known):
        raise ValueError(f"{caller} needs a rotation of each camera; got {len(R)} for {len(known)} cameras")
    if not np.linalg.norm(t, axis=1).min(initial=1.0) > 0.0:
        raise ValueError(f"{caller} needs translations that are not zero")
    n, turned = len(R), np.isfinite(R).all(axis=(1, 2))
    require_rotations(caller, R[turned])
    known = np.append(known, np.zeros(n - len(known), dtype=bool)) & turned
    use = known[i] & known[j]
    if not use.any():
        raise ValueError(f"{caller} needs rotations of cameras that pairs connect with the first one")
    a, b, given = i[use], j[use], given[use]
    v = -np.einsum("eji,ej->ei", R[b], t[use] / np.linalg.norm(t[use], axis=1, keepdims=True))
    free, D = _differences(a, b, known)
    centres, w = np.zeros((n, 3)), given
    length = np.ones(len(a))
    for _ in range(_ROUNDS):
        centres[free] = _solve(D, w, (w * length)[:, None] * v)
        d = centres[b] - centres[a]
        length = np.maximum(np.einsum("ei,ei->e", d, v), 1.0)
        w = given / np.maximum(np.linalg.norm(d - length[:, None] * v, axis=1), 1e-3)
    D3 = scipy.sparse.csc_array(scipy.sparse.kron(D, scipy.sparse.eye_array(3)))
    across = np.eye(3) - v[:, :, None] * v[:, None]
    angle, weight = np.zeros(len(a)), np.ones(len(a))
    for k in range(_ROUNDS // 2):
        d = centres[b] - centres[a]
        angle = np.arctan2(np.linalg.norm(np.cross(v, d), axis=1), np.einsum("ei,ei->e", v, d))
        weight = _loss_weights(angle, _ROUNDS)
        if k + 1 == _ROUNDS // 2:
            break
        # The sine of the angle is |(I - v v') d| / |d|; the sum of v' d fixes the scale.
        size = np.linalg.norm(d, axis=1)
        w = given * weight / np.maximum(size, 1e-3 * np.median(size)) ** 2
        A = D3.T @ scipy.sparse.block_diag(list(w[:, None, None] * across), format="csc") @ D3
        centres[free] = _solve_positive(A, D3.T @ (w[:, None] * v).ravel()).reshape(-1, 3)
    centres -= centres[known].mean(axis=0)
    centres /= np.sqrt((centres[known] ** 2).sum(axis=1).mean()) or 1.0
    return AveragedCentres(np.where(known[:, None], centres, np.nan), *_of_all_pairs(use, angle, weight))


def _graph(caller: str, pairs: I64, weights: F64 | None) -> tuple[I64, I64, F64, B8]:
    """Return the cameras and the weight of each pair, and which cameras are connected with camera 0."""
    ends = whole_numbers(caller, "pairs", pairs)
    two = ends.ndim == 2 and ends.shape[1] == 2 and len(ends) > 0
    if not two or ends.min() < 0 or (ends[:, 0] == ends[:, 1]).any():
        raise ValueError(f"{caller} needs pairs (E, 2) of two different cameras, numbered from 0")
    given = np.ones(len(ends)) if weights is None else numbers(caller, weights=weights)[0]
    if given.shape != (len(ends),) or not (np.isfinite(given) & (given > 0.0)).all():
        raise ValueError(f"{caller} needs a positive weight for each of the {len(ends)} pairs")
    i, j = ends.T
    n = int(ends.max()) + 1
    if n > 100 * len(ends) + 100:
        raise ValueError(f"{caller} needs cameras that are numbered from 0; got {n - 1} in {len(ends)} pairs")
    graph = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), (n, n))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return i, j, given, np.asarray(label == label[0])


def _of_all_pairs(use: B8, angle: F64, weight: F64) -> tuple[F64, F64]:
    """Return angles in degrees and weights (E,) of all pairs, NaN where they are not used."""
    residual, last = (np.full(len(use), np.nan) for _ in range(2))
    residual[use], last[use] = np.degrees(angle), weight
    return residual, last


def _along_tree(i: I64, j: I64, relative: F64, weights: F64, n: int) -> F64:
    """Return rotations (n, 3, 3) chained from camera 0 along the pairs of greatest weight."""
    number = scipy.sparse.coo_array((weights.max() * 2.0 - weights, (i, j)), (n, n)).tocsr()
    number.sum_duplicates()
    tree = scipy.sparse.csgraph.minimum_spanning_tree(number)
    order, before = scipy.sparse.csgraph.breadth_first_order(tree, 0, directed=False)
    pair = {(a, b): k for k, (a, b) in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
    average = np.tile(np.eye(3), (n, 1, 1))
    for c in order[1:].tolist():
        p = int(before[c])
        forward = pair.get((p, c))
        average[c] = (relative[forward] if forward is not None else relative[pair[c, p]].T) @ average[p]
    return average


def _loss_weights(residual: F64, k: int) -> F64:
    """Return weights of round k: of the sum of residuals, then of Geman and McClure's loss."""
    if k < _ROUNDS // 2:
        # A residual that is zero at the start must not hold its pair there.
        least = max(0.5**k, _SMALLEST)
        return np.asarray(least / np.maximum(residual, least))
    width = max(5.0 * float(np.median(residual)), _SMALLEST)
    return np.asarray((1.0 + (residual / width) ** 2) ** -2.0)


def _differences(a: I64, b: I64, known: B8) -> tuple[I64, scipy.sparse.csc_array]:
    """Return the ``known`` cameras but the first one, whose x is 0, and D (E, n) with D x = x_b - x_a."""
    free, rows = np.flatnonzero(known)[1:], np.repeat(np.arange(len(a)), 2)
    entries = np.tile([-1.0, 1.0], len(a)), (rows, np.column_stack([a, b]).ravel())
    return free, scipy.sparse.csc_array(scipy.sparse.csc_array(entries, shape=(len(a), len(known)))[:, free])


def _solve(D: scipy.sparse.csc_array, w: F64, right: F64) -> F64:
    """Return x (n, 3) of least sum w |D x - b|^2; ``right`` = w b."""
    if not D.shape[1]:
        return np.zeros((0, 3))
    return _solve_positive(D.T @ scipy.sparse.diags_array(w) @ D, D.T @ right)


def _solve_positive(A: scipy.sparse.csc_array, right: F64) -> F64:
    """Solve A x = right; directions without information do not move."""
    least = 1e-12 * float(A.diagonal().max()) + 1e-300
    factor = scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(A + least * scipy.sparse.eye_array(A.shape[0])), permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0, options={"SymmetricMode": True},
    )  # fmt: skip
    return np.asarray(factor.solve(right))
