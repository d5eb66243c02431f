r"""
3. One reconstruction in three strata
=====================================

In :term:`homogeneous coordinates`, equal up to scale, a camera maps a point :math:`X = (X, Y, Z, 1)^\top` to
a pixel :math:`x \simeq P X` with a 3 x 4 matrix :math:`P = K\,[R \; t]`: :math:`R` and :math:`t` turn world
coordinates into those of the camera, :math:`K` holds the focal length and the :term:`principal point`.
Because :math:`P X = (P G^{-1}) (G X)` for any invertible 4 x 4 matrix :math:`G`, images cannot determine
:math:`G` (section 3.3; HZ 10.2). Such a *projective* reconstruction keeps straight lines, but parallel lines
may meet. It becomes *affine* when the :term:`plane at infinity`, where they meet, is found and moved to
:math:`(0, 0, 0, 1)` (3.4.3), and *metric* when the :term:`absolute conic` on it is found too (3.4.4): angles
and ratios of lengths are then true. Below, a grid on the cube is triangulated in each frame (6.3). Residuals
and :term:`cross-ratios <cross-ratio>` are the same in all three, the two halves of an edge are equal in the
affine and the metric frame, and angles are right in the metric frame.
"""

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

cube = np.load(thesisrecon.sample("cube") / "cube.npz")
views = np.flatnonzero(np.isfinite(cube["xy"][..., 0]).sum(axis=1) > 200)[::2]
noisy = cube["xy"][views] + np.random.default_rng(0).normal(0, 0.5, (len(views), 360, 2))
sizes = [(800, 600)] * len(views)
run = thesisrecon.reconstruct_from_tracks(noisy, sizes, until="projective")
plane = thesisrecon.plane_at_infinity(run.projective)
upgrade = thesisrecon.self_calibrate(run.projective).metric_from_projective
free = np.array([[1, 0.5, 0.2, 0], [0, 0.7, -0.3, 0], [0.2, 0, 1.3, 0]])  # any three rows
affine = np.vstack([free, plane / plane[3]])
distorted = np.vstack([free, plane / plane[3] + (0.5, -0.2, 0.3, 0.0)])
frames = {"projective": distorted, "affine": affine, "metric": upgrade}
(s, t), ones = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), np.ones((5, 5))
faces = [(ones, s, t), (s, ones, t), (s, t, ones)]
grid = np.moveaxis(faces, 1, -1).reshape(-1, 3)
poses = zip(cube["R"][views], cube["C"][views], strict=True)
cameras = [thesisrecon.Camera(cube["K"], R, -R @ C, (800, 600)) for R, C in poses]
marked = np.stack([camera.project(grid) for camera in cameras])
view = {"projection": "3d", "proj_type": "ortho", "elev": -60, "azim": -70}
figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained", subplot_kw=view)
for axis, (name, G) in zip(axes, frames.items(), strict=True):
    P = run.projective.P @ np.linalg.inv(G)
    X = thesisrecon.triangulate(P, marked)
    images = np.einsum("vij,nj->vni", P, X)
    residual = np.sqrt(np.mean((images[..., :2] / images[..., 2:] - marked) ** 2))
    faces = (X[:, :3] / X[:, 3:]).reshape(3, 5, 5, 3)
    for face, colour in zip(faces, ("tab:red", "tab:green", "tab:blue"), strict=True):
        axis.plot_wireframe(*np.moveaxis(face, -1, 0), color=colour)
    axis.set(title=name, aspect="equal")
    axis.set_axis_off()
    edge, other = faces[0, 0], faces[0, 4, 0] - faces[0, 0, 0]
    length = np.linalg.norm(edge[:, None] - edge, axis=2)
    cross = length[0, 2] * length[1, 3] / (length[0, 3] * length[1, 2])
    halves = length[0, 2] / length[2, 4]
    cosine = (edge[4] - edge[0]) @ other / length[0, 4] / np.linalg.norm(other)
    angle = np.degrees(np.arccos(cosine))
    found = f"cross-ratio {cross:.3f}, halves {halves:.3f}, {angle:.1f}°"
    print(f"{name}: residual {residual:.2f} px, {found}")
