"""Checks of the factorisation."""

from types import SimpleNamespace

import numpy as np

import thesisrecon

UNIT, RETURNS = "px", [("M", ("V", 2, 3)), ("t", ("V", 2)), ("X", ("N", 3))]
V, N, SIGMA = 6, 50, 0.5


def data(rng):
    M = 100 * np.linalg.qr(rng.normal(size=(V, 3, 3)))[0][:, :2]
    exact = rng.normal(size=(N, 3)) @ np.swapaxes(M, 1, 2) + rng.uniform(300, 700, (V, 1, 2))
    return SimpleNamespace(inputs=(exact + rng.normal(0, SIGMA, exact.shape),), exact=exact)


def _pixels(output):
    M, t, X = output
    return X @ np.swapaxes(M, 1, 2) + t[:, None]


def error(output, case):
    return np.sqrt(np.mean(np.sum((_pixels(output) - case.exact) ** 2, axis=2)))


def bound(_):
    # 8 V + 3 N - 12 parameters share the noise of 2 V N numbers.
    return SIGMA * np.sqrt((8 * V + 3 * N - 12) / (V * N))


def ours(case):
    found = thesisrecon.factorize_affine(*case.inputs)
    return found.M, found.t, found.X


def vector(output, _):
    """Independent of the affine frame."""
    return np.concatenate([np.ravel(_pixels(output)), np.ravel(output[1])]) / 100


def _of(xy, t, power=1.0, rank=3, first=0):
    W = (xy - t).transpose(0, 2, 1).reshape(-1, xy.shape[1])
    U, s, Vt = np.linalg.svd(W, full_matrices=False)
    part = slice(first, first + rank)
    M = np.zeros((len(U), 3))
    X = np.zeros((xy.shape[1], 3))
    M[:, :rank], X[:, :rank] = U[:, part] * s[part] ** power, Vt[part].T
    return M.reshape(-1, 2, 3), X


def _all(xy):
    return np.broadcast_to(xy.mean(axis=(0, 1)), (len(xy), 2))


def _wrong(t_of, t_returned=None, **options):
    def wrong(_, xy):
        t = t_of(xy)
        M, X = _of(xy, t[:, None], **options)
        return M, (t if t_returned is None else t_returned(xy)), X

    return wrong


def _mean(xy):
    return xy.mean(axis=1)


def _none(xy):
    return np.zeros((len(xy), 2))


MISTAKES = {
    "the mean is not subtracted before the SVD": _wrong(_none),
    "the mean is not subtracted before the SVD, but added at last": _wrong(_none, _mean),
    "one mean for all images is subtracted: each image has its own": _wrong(_all),
    "t is not the mean of the pixels": _wrong(_mean, _none),
    "the singular values are used twice, in M and in X": _wrong(_mean, power=2.0),
    "the singular values are not used": _wrong(_mean, power=0.0),
    "the rank is 2: take three singular values": _wrong(_mean, rank=2),
    "the last three singular values are taken, not the first": _wrong(_mean, first=2 * V - 3),
    "only the square root of the singular values is used": _wrong(_mean, power=0.5),
    "the first singular value is left out": _wrong(_mean, first=1),
    "x and y are swapped": lambda solve, xy: solve(xy[..., ::-1]),
    "x and y of M are mixed: the rows of W are x and y of image 1, of image 2 ...": lambda solve, xy: (
        lambda M, t, X: (M.transpose(1, 0, 2).reshape(-1, 2, 3), t, X)
    )(*solve(xy)),
}
