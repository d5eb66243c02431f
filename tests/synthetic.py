"""Synthetic scenes and textured images for all tests."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.records import FundamentalFit, Image, Reconstruction, Tracks, TwoView


@dataclass(frozen=True)
class TrueScene:
    """K, R, t, centres per view, points, tracks and image sizes."""

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    X: np.ndarray
    k1: float
    tracks: Tracks
    sizes: np.ndarray

    @property
    def P(self):
        return compose_camera(self.K, self.R, self.t)

    @property
    def centres(self):
        return -np.einsum("vba,vb->va", self.R, self.t)


def looking_along(direction):
    """World-to-camera rotation (3, 3) of a level camera that looks along a direction, y down."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def make_scene(
    *,
    views=8,
    points=300,
    sigma_px=0.0,
    focal=1500.0,
    zoom=0.0,
    principal_shift=(0.0, 0.0),
    k1=0.0,
    seen_share=0.75,
    seed=0,
):
    """Cameras on an irregular cap around a cloud of points, turned and rolled as a hand would."""
    rng = np.random.default_rng(seed)
    size = np.array([1536, 1024])
    X = rng.uniform([-2.0, -1.6, -1.5], [2.0, 1.6, 1.5], (points, 3))
    K, R, t = [], [], []
    for _ in range(views):
        # Azimuth and elevation.
        a, e = rng.uniform(-0.7, 0.7), rng.uniform(-0.35, 0.35)
        direction = np.array([np.sin(a) * np.cos(e), np.sin(e), -np.cos(a) * np.cos(e)])
        centre = rng.uniform(6.0, 9.0) * direction
        level = looking_along(rng.normal(0.0, 0.3, 3) - centre)
        rotation = Rotation.from_euler("z", rng.uniform(-0.3, 0.3)).as_matrix() @ level
        f = focal * np.exp(rng.uniform(-zoom, zoom))
        cx, cy = (size - 1) / 2 + np.array(principal_shift)
        K.append([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        R.append(rotation)
        t.append(-rotation @ centre)
    Ka, Ra, ta = np.array(K), np.array(R), np.array(t)
    seen = rng.random((views, points)) < seen_share
    seen[:2] |= ~(seen.sum(axis=0) >= 2)
    point, view = np.nonzero(seen.T)
    xy = np.empty((len(view), 2))
    for v in range(views):
        mine = view == v
        xy[mine] = project_camera(Ka[v], Ra[v], ta[v], X[point[mine]], distortion=k1)
    xy += rng.normal(0.0, sigma_px, xy.shape) if sigma_px else 0.0
    tracks = Tracks(view, point, xy, views, points)
    return TrueScene(Ka, Ra, ta, X, k1, tracks, np.tile(size, (views, 1)))


def with_poses(scene, R, centres):
    """The same points seen without noise by cameras that stand and look elsewhere."""
    t = -np.einsum("vab,vb->va", R, centres)
    view, point = scene.tracks.view_index, scene.tracks.point_index
    xy = np.empty((len(view), 2))
    for v in range(len(R)):
        mine = view == v
        xy[mine] = project_camera(scene.K[v], R[v], t[v], scene.X[point[mine]], distortion=scene.k1)
    return replace(scene, R=R, t=t, tracks=replace(scene.tracks, xy=xy))


def reconstruction_of(P, size, *, X=None, tracks=None, stratum="metric", **given):
    """A reconstruction whose views, points and observations are all good, but for the ``given`` fields."""
    n, X = len(P), np.zeros((0, 4)) if X is None else X
    if tracks is None:
        nothing = np.zeros(0, dtype=np.int64)
        tracks = Tracks(nothing, nothing, np.zeros((0, 2)), n, len(X))
    fields = {"sizes": np.broadcast_to(size, (n, 2)).copy(), "sigma_px": 0.1, "reasons": ("",) * n}
    for name, count in (("registered", n), ("valid", len(X)), ("inlier", len(tracks.xy))):
        fields[name] = np.ones(count, dtype=bool)
    if "K" in given:
        fields |= {"distortion": np.zeros((n, 3))}
    return Reconstruction(stratum=stratum, P=P, X=X, tracks=tracks, **(fields | given))


def projective_reconstruction(scene, *, seed=0):
    """The true cameras and points moved by a random projective transform, with random scales and signs."""
    rng = np.random.default_rng(seed)
    G = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    P = scene.P @ np.linalg.inv(G)
    P = P * (rng.uniform(0.5, 2.0, len(P)) * rng.choice([-1.0, 1.0], len(P)))[:, None, None]
    X = np.column_stack([scene.X, np.ones(len(scene.X))]) @ G.T
    X = X * rng.choice([-1.0, 1.0], len(X))[:, None]
    return reconstruction_of(P, scene.sizes, X=X, tracks=scene.tracks, stratum="projective", sigma_px=1.0)


def true_pairs(scene):
    """Every pair with its true F and all common points as verified matches."""
    t = scene.tracks
    table = np.full((t.n_views, t.n_points), -1)
    table[t.view_index, t.point_index] = np.arange(len(t.xy))
    pairs = []
    for i in range(t.n_views):
        for j in range(i + 1, t.n_views):
            both = np.flatnonzero((table[i] >= 0) & (table[j] >= 0))
            R = scene.R[j] @ scene.R[i].T
            translation = scene.t[j] - R @ scene.t[i]
            F = np.linalg.inv(scene.K[j]).T @ cross_matrix(translation) @ R @ np.linalg.inv(scene.K[i])
            F, xy = F / np.linalg.norm(F), (t.xy[table[i, both]], t.xy[table[j, both]])
            affine, count = np.tile(np.eye(2), (len(both), 1, 1)), len(both)
            pairs.append(TwoView(i, j, F, 0.3, both, both, *xy, affine, count, 0.2, True))
    return pairs


def texture(height, width, seed=0):
    """(H, W) grey values about 128: noise of several sizes, as rich in corners as a stone wall."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for sigma in (1.2, 2.5, 5.0, 10.0):
        layer = gaussian_filter(rng.normal(size=(height, width)), sigma)
        total += layer / layer.std() * sigma**0.3
    return np.clip(128.0 + 38.0 * total / total.std(), 0.0, 255.0)


def photograph(gray, name="a.png"):
    """A grey photograph."""
    values = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return Image(name, np.repeat(values[:, :, None], 3, axis=2), (gray.shape[1], gray.shape[0]))


def disparity(xy2):
    """(N,) disparity of the stereo scene at pixels of the second image: x1 = x2 + disparity, y1 = y2."""
    return 14.0 + 5.0 * np.sin(xy2[:, 0] / 60.0) + 4.0 * np.cos(xy2[:, 1] / 45.0)


def stereo_scene(height=300, width=420, seed=3):
    """Two photographs of a curved surface by cameras side by side; the second is darker and duller."""
    first = texture(height, width, seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    shifted = x + disparity(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
    second = map_coordinates(first, [y, shifted], order=3, mode="reflect")
    return photograph(first, "left.png"), photograph(0.8 * second + 10.0, "right.png")


def sideways_fundamental(xy1, xy2, rng):
    """The true F of cameras side by side, with the matches that obey it: stands in for chapter 5."""
    del rng
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) / np.sqrt(2.0)
    inliers = np.abs(xy1[:, 1] - xy2[:, 1]) < 2.0
    return FundamentalFit(F, inliers, 0.5, np.zeros((9, 9)))


def one_by_one(function, items):
    """The parallel map of the stages, without threads."""
    return [function(item) for item in items]
