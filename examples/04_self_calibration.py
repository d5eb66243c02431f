r"""
4. Self-calibration by each method
==================================

Which 4 x 4 matrix makes the reconstruction :term:`metric <metric stratum>`? The :term:`absolute conic` lies
on the plane at infinity, and its image depends on the calibration alone, not on the pose of the camera. Its
dual, the absolute dual quadric :math:`\Omega^*` (4 x 4, symmetric, rank 3, null vector :math:`\Pi_\infty`),
has the image (3.14; HZ 19.3)

.. math:: P_i\, \Omega^* P_i^\top \simeq \omega_i^* = K_i K_i^\top, \quad
   K = \begin{pmatrix} f & 0 & u \\ 0 & f & v \\ 0 & 0 & 1 \end{pmatrix},

with the focal length :math:`f` and the :term:`principal point` :math:`(u, v)`. So all that is known of
:math:`K` gives equations for :math:`\Omega^*`. All methods below get one projective reconstruction and the
same knowledge: one camera, square pixels, a principal point near the centre.
"""

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

cube = np.load(thesisrecon.sample("cube") / "cube.npz")
views = np.flatnonzero(np.isfinite(cube["xy"][..., 0]).sum(axis=1) > 200)[::2]
noisy = cube["xy"][views] + np.random.default_rng(0).normal(0, 0.5, (len(views), 360, 2))
run = thesisrecon.reconstruct_from_tracks(noisy, [(800, 600)] * len(views))

# %%
# - **linear-quadric**: linear equations for :math:`\Omega^*`; biased for lenses other than 60 mm.
# - **nonlinear-quadric**: the nearest :math:`K K^\top` to all :math:`P_i \Omega^* P_i^\top`.
# - **kruppa-equations**: from F and its :term:`epipole` e in image 2 alone (:term:`Kruppa equations`),
#   :math:`F \omega^* F^\top \simeq [e]_\times \omega^* [e]_\times^\top`.
# - **modulus-constraint**: first :math:`\Pi_\infty`. It maps image to image by a matrix that is similar to a
#   rotation, with eigenvalues of one modulus: a quartic equation in :math:`\Pi_\infty` for each pair.
# - **cheirality-search**: first :math:`\Pi_\infty`, which must have all points and cameras on one side.
# - **hypotheses-and-refinement**: the default: many starts, one criterion, the principal point still fixed.
# - **metric stage**: :term:`bundle adjustment`, which minimises distances in the images.
#
# The intervals of single methods are of first order and somewhat narrow; rely on those of the metric stage.

methods = ["linear-quadric", "nonlinear-quadric", "kruppa-equations", "modulus-constraint"]
found = {}
for method in [*methods, "cheirality-search", "hypotheses-and-refinement"]:
    calibration = thesisrecon.self_calibrate(run.projective, method=method)
    found[method] = calibration.K[0], calibration.K_std[0, 0, 0]
    for reason in calibration.reasons:
        print(f"{method}: {reason}")
found["metric stage"] = run.cameras[0].K, run.cameras[0].std["focal_px"]
figure, axes = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
for row, (method, (K, std)) in enumerate(found.items()):
    axes[0].errorbar(K[0, 0], row, xerr=1.96 * np.nan_to_num(std), fmt="o", capsize=4)
    axes[1].plot(K[0, 2], K[1, 2], "o", label=method)
axes[0].axvline(cube["K"][0, 0], color="k", linestyle="--")
axes[0].set_yticks(range(len(found)), found)
axes[0].set_xlabel("focal length and 95 % interval, px")
axes[1].plot(*cube["K"][:2, 2], "k*", markersize=14, label="truth")
axes[1].set(xlabel="principal point x, px", ylabel="y, px")
axes[1].legend(fontsize="small")
