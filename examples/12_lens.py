r"""
12. A lens that bends lines
===========================

A pinhole images lines as lines; the wide lenses of action cameras and phones do not. Matches of two images
then have no :term:`fundamental matrix`. One number nearly restores it: with places :math:`p` from the
middle of the image in half diagonals, the division model (Fitzgibbon 2001) has straight points

.. math:: x \simeq (p,\; 1 + k_1 |p|^2), \qquad x_2^\top F\, x_1 = 0.

Of some values of :math:`k_1` the one whose :math:`F` explains most matches of several pairs is refined, and
all that needs a pinhole uses straight points. Bundle adjustment then has the images as they are and a lens
model: here

.. math:: r = f\,\theta\,(1 + k_1 \theta^2 + k_2 \theta^4 + \dots),

where a ray at the angle :math:`\theta` from the axis is imaged at :math:`r` (Kannala and Brandt 2006), also
beyond 90 degrees. Twelve cameras of 148 degrees stand in a room; nothing is known about them. Left: the lines
of a square grid before the camera. Right: the error of the angle that the found lens has for each radius, and
its interval at the corner.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon import Camera

rng, size, n = np.random.default_rng(4), (1000, 750), 12
X = rng.uniform(-1, 1, (1500, 3))
wall = rng.integers(0, 3, len(X))
X[np.arange(len(X)), wall] = np.sign(X[np.arange(len(X)), wall])
X *= 7, 3.5, 7
K, k = np.array([[400.0, 0, 505], [0, 400, 370], [0, 0, 1]]), np.array([-0.02, 0.001])
around = 2 * np.pi * np.arange(n) / n
R = Rotation.from_euler("yx", np.c_[around, rng.normal(0, 0.1, n)]).inv().as_matrix()
C = 2.5 * np.c_[np.sin(around), 0.2 * np.sin(3 * around), np.cos(around)]
cameras = [Camera(K, r, -r @ c, size, k, lens="fisheye") for r, c in zip(R, C, strict=True)]
xy = np.array([camera.project(X) for camera in cameras]) + rng.normal(
    0, 0.3, (n, len(X), 2)
)
ahead = np.einsum("va,vna->vn", R[:, 2], X - C[:, None]) > 0
xy[~(ahead & (xy > 0).all(axis=2) & (xy < np.array(size) - 1).all(axis=2))] = np.nan

result = thesisrecon.reconstruct_from_tracks(xy, [size] * n)
camera, truth = result.cameras[0], cameras[0]
found = np.array([result.cameras[i].centre for i in range(n)])
scale = np.linalg.norm(found - found[0], axis=1)[1:] / np.linalg.norm(C - C[0], axis=1)[1:]
print(
    f"lens: {camera.lens}, distances of cameras equal to {np.ptp(scale) / scale.mean():.2%}"
)
for name, value, true in zip(
    ("angle_of_view_deg", "corner_deg"),
    camera.angles_of_view,
    truth.angles_of_view,
    strict=True,
):
    print(f"{name}: {value:.2f} ± {1.96 * camera.std[name]:.2f} (true {true:.2f})")

figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
a, b = np.meshgrid(np.linspace(-1.5, 1.5, 9), np.linspace(-1.5, 1.5, 99))
for x, y in ((a, b), (b, a)):
    lines = Camera(K, np.eye(3), np.zeros(3), size, k, lens="fisheye").project(
        np.stack([x, y, np.full_like(x, 1.2)], axis=-1).reshape(-1, 3)
    )
    axes[0].plot(
        *lines.reshape(*x.shape, 2).transpose(2, 0, 1), color="tab:blue", linewidth=0.8
    )
axes[0].set(
    aspect="equal", xlim=(0, size[0]), ylim=(size[1], 0), xlabel="x, px", ylabel="y, px"
)
radius = np.linspace(1, 600, 200)


def angles(one):
    """Angles from the axis, degrees, at radii from the principal point."""
    rays = one.unproject(one.K[:2, 2] + np.c_[radius, 0 * radius]) @ one.R.T
    return np.degrees(np.arccos(rays[:, 2]))


axes[1].plot(radius, angles(camera) - angles(truth), color="tab:blue")
corner = np.linalg.norm(np.maximum(K[:2, 2], np.array(size) - K[:2, 2]))
axes[1].errorbar(corner, 0, 1.96 * camera.std["corner_deg"], color="k", capsize=4)
axes[1].axhline(0, color="k", linestyle="--")
axes[1].set(
    xlabel="distance from the principal point, px", ylabel="error of the angle, degrees"
)
