r"""
3. One reconstruction in three strata
=====================================

A camera maps a point of space in :term:`homogeneous coordinates` :math:`X = (X, Y, Z,
1)^\top` to a pixel by :math:`x \simeq P X`, equal up to scale, with a 3 x 4 matrix :math:`P
= K\,[R \; t]`: :math:`R` and :math:`t` turn world coordinates into those of the camera, and
:math:`K` holds the focal length and the :term:`principal point`. From matches alone the
cameras and points are determined up to one 4 x 4 matrix, because for every invertible
:math:`G` (section 3.3; HZ 10.2)

.. math:: P X = (P G^{-1}) (G X),

so both have the same images. The result is a *projective* reconstruction: lines stay lines
and contacts stay contacts, but parallel lines may meet. It becomes *affine* if the
:term:`plane at infinity` :math:`\Pi_\infty`, where parallel lines meet, is found and moved
to :math:`(0, 0, 0, 1)` (3.4.3), and *metric* if the :term:`absolute conic` on that plane is
found as well (3.4.4): angles and ratios of lengths are then true, only the scale is
unknown.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon
from thesisrecon.geometry.strata import transform

cube = np.load(Path(thesisrecon.__file__).parents[1] / "fixtures" / "cube" / "cube.npz")
views = np.flatnonzero(np.isfinite(cube["xy"][..., 0]).sum(axis=1) > 200)[::2]
noisy = cube["xy"][views] + np.random.default_rng(0).normal(0, 0.5, (len(views), 360, 2))
sizes = [(800, 600)] * len(views)
run = thesisrecon.reconstruct_from_tracks(noisy, sizes, until="projective")
plane = thesisrecon.plane_at_infinity(run.projective)
upgrade = thesisrecon.self_calibrate(run.projective).metric_from_projective
# Any three rows will do.
free = np.array([[1.0, 0.5, 0.2, 0.0], [0.0, 0.7, -0.3, 0.0], [0.2, 0.0, 1.3, 0.0]])
affine = np.vstack([free, plane / plane[3]])
distorted = np.vstack([free, plane / plane[3] + (0.5, -0.2, 0.3, 0.0)])
frames = {"projective": distorted, "affine": affine, "metric": upgrade}

# %%
# A grid on the faces of the cube is triangulated in each frame (6.3). Residuals and
# cross-ratios stay, the two halves of an edge are equal from the affine frame on, and
# angles are right in the metric frame.

(s, t), ones = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), np.ones((5, 5))
faces = (ones, s, t), (s, ones, t), (s, t, ones)
grid = np.stack([np.dstack(face) for face in faces]).reshape(-1, 3)
poses = zip(cube["R"][views], cube["C"][views], strict=True)
marked = np.stack(
    [thesisrecon.Camera(cube["K"], R, -R @ C, (800, 600)).project(grid) for R, C in poses]
)
figure = plt.figure(figsize=(12, 4), layout="constrained")
for k, (name, G) in enumerate(frames.items()):
    X = thesisrecon.triangulate(P := transform(G, run.projective.P, "cameras"), marked)
    images = np.einsum("vij,nj->vni", P, X)
    residual = np.sqrt(np.mean((images[..., :2] / images[..., 2:] - marked) ** 2))
    faces = (X[:, :3] / X[:, 3:]).reshape(3, 5, 5, 3)
    axis = figure.add_subplot(1, 3, k + 1, projection="3d", title=name, proj_type="ortho")
    for face, colour in zip(faces, ("tab:red", "tab:green", "tab:blue"), strict=True):
        axis.plot_wireframe(*np.moveaxis(face, -1, 0), color=colour)
    axis.set_aspect("equal")
    axis.view_init(-60, -70)
    axis.set_axis_off()
    edge, other = faces[0, 0], faces[0, 4, 0] - faces[0, 0, 0]
    length = np.linalg.norm(edge[:, None] - edge, axis=2)
    cross = length[0, 2] * length[1, 3] / (length[0, 3] * length[1, 2])
    halves = length[0, 2] / length[2, 4]
    cosine = (edge[4] - edge[0]) @ other / length[0, 4] / np.linalg.norm(other)
    angle = np.degrees(np.arccos(cosine))
    found = f"cross-ratio {cross:.3f}, halves {halves:.3f}, {angle:.1f}°"
    print(f"{name}: residual {residual:.2f} px, {found}")
