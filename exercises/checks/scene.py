"""Points and cameras with truth: those of the courtyard that comes with thesisrecon."""

import json
from functools import cache
from types import SimpleNamespace

import numpy as np
from PIL import Image

import thesisrecon


@cache
def _courtyard():
    folder = thesisrecon.sample("courtyard")
    cameras = json.loads((folder / "cameras.json").read_text("utf-8"))
    cameras = cameras["cameras"] if isinstance(cameras, dict) else cameras
    K, R, t = (np.array([camera[key] for camera in cameras]) for key in ("K", "R", "t"))
    depth = np.asarray(Image.open(folder / "depth" / "0006.png"), dtype=float) * 0.00025
    rows, columns = np.nonzero(depth[::8, ::8])
    z = depth[8 * rows, 8 * columns]
    rays = homogeneous(np.stack([16.0 * columns, 16.0 * rows], axis=1)) @ np.linalg.inv(K[6]).T
    X = (rays * z[:, None] - t[6]) @ R[6]
    return K, R, t, X


def homogeneous(x):
    """Points with a last coordinate of 1."""
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def divided(x):
    """Homogeneous points divided by their last coordinate, which is left out."""
    return x[..., :-1] / x[..., -1:]


def project(P, X):
    """Pixels of points (N, 3) in cameras (..., 3, 4)."""
    return divided(homogeneous(X) @ np.swapaxes(P, -1, -2))


def courtyard(rng, views, n):
    """Cameras of the courtyard by number, and n points of it that are inside all their images."""
    K, R, t, X = _courtyard()
    K, R, t = (one[list(views)] for one in (K, R, t))
    P = K @ np.concatenate([R, t[..., None]], axis=2)
    xy = project(P, X)
    inside = ((xy > 0) & (xy < (1023, 767))).all(axis=(0, 2)) & ((X @ R[0].T + t[0])[:, 2] < 12)
    some = rng.choice(np.flatnonzero(inside), n, replace=False)
    return SimpleNamespace(K=K, R=R, t=t, P=P, X=X[some], xy=xy[:, some])


def true_fundamental(P1, P2):
    """F of two cameras."""
    C = np.linalg.svd(P1)[2][-1]
    e = P2 @ C
    return np.cross(np.eye(3), e) @ P2 @ np.linalg.pinv(P1)


def epipolar_rms(F, xy1, xy2):
    """RMS distance of points from the epipolar lines in both images, px."""
    x1, x2 = homogeneous(xy1), homogeneous(xy2)
    l2, l1 = x1 @ F.T, x2 @ F
    off = np.einsum("ni,ni->n", x2, l2)
    d = [off / np.maximum(np.hypot(l[:, 0], l[:, 1]), 1e-300) for l in (l1, l2)]
    return float(np.sqrt(np.mean(np.square(d))))


def degrees(R, Q):
    """Angle between two rotations."""
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(R - Q) / np.sqrt(8)))))


def rotation_faults(R):
    """A sentence if R is not a rotation."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6:
        return ["R is not a rotation: R R' is not the unit matrix"]
    return ["R is not a rotation: det R = -1"] if np.linalg.det(R) < 0 else []
