r"""
6. Bundle adjustment and its intervals against the truth
========================================================

:term:`Bundle adjustment <bundle adjustment>` (6.7; HZ 18.1) moves all cameras and points
together until the images are explained best,

.. math:: \min \sum_{ij} \rho\!\left( \| x_{ij} - \pi(P_i, X_j) \|^2 / \sigma^2 \right),

the maximum likelihood estimate for normal noise. Its normal equations also tell how precise
the result is: with the Jacobian :math:`J` the covariance of the unknowns is :math:`\Sigma =
\sigma^2 (J^\top J)^+` (HZ 5.2). This is the pseudo-inverse, because :math:`J^\top J` is
singular: seven directions, the choice of the frame and the scale of the world (the
:term:`gauge`), change no image. An interval of :math:`\pm 1.96` :term:`standard deviations
<standard deviation>` should contain the truth in 95 of 100 cases. For :math:`N` observed
coordinates and :math:`d` unknowns the residuals are smaller than the noise:
:math:`\sigma\sqrt{1 - d/N}` (HZ result 5.2), where the seven directions do not count: the
-7 in the code. Here both promises are tested: the cube, whose truth is known, is observed
100 times with new noise.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

cube = np.load(Path(thesisrecon.__file__).parents[1] / "fixtures" / "cube" / "cube.npz")
views = np.flatnonzero(np.isfinite(cube["xy"][..., 0]).sum(axis=1) > 200)[::2]
exact, K = cube["xy"][views], cube["K"]
R, C, sigma = cube["R"][views], cube["C"][views], 0.5
t, rng, trials = -np.einsum("vij,vj->vi", R, C), np.random.default_rng(0), 100
start = K @ np.diag([1.1, 1.1, 1.0])
estimate, std = np.zeros((2, trials, 3))
residual, covariance = np.zeros(trials), 0.0
for i in range(trials):
    xy = exact + rng.normal(0, sigma, exact.shape)
    X = cube["X"] + rng.normal(0, 0.05, cube["X"].shape)
    free = ("focal", "principal_point")
    found = thesisrecon.bundle_adjust(
        (start, R, t), X, xy, sizes=(800, 600), free=free, loss="squared"
    )
    camera = found.cameras[0]
    estimate[i] = camera.K[0, 0], camera.K[0, 2], camera.K[1, 2]
    std[i] = [camera.std[name] for name in ("focal_px", "principal_x_px", "principal_y_px")]
    residual[i] = np.sqrt(np.nanmean(found.residual_px**2))
    covariance = covariance + found.intrinsics_covariance[0][3:5, 3:5] / trials

# %%
# Left: each trial's focal length with its 95 % interval, sorted. Right: the principal
# points and the ellipse that the mean covariance predicts for 95 % of them (:math:`\chi^2`
# of two degrees of freedom: 5.99).

truth = K[[0, 0, 1], [0, 2, 2]]
inside, order = np.abs(estimate - truth) < 1.96 * std, estimate[:, 0].argsort()
N, d = 2 * np.isfinite(exact[..., 0]).sum(), 6 * len(views) + 3 * len(X) + 3 - 7
figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
colours = np.where(inside[order, 0], "tab:blue", "tab:red")
axes[0].errorbar(
    range(trials), estimate[order, 0], 1.96 * std[order, 0], fmt="none", ecolor=colours
)
axes[0].axhline(truth[0], color="k", linestyle="--")
axes[0].set(xlabel="trial", ylabel="focal length, px")
circle = np.linalg.cholesky(5.99 * covariance) @ np.array(
    [np.cos(a := np.linspace(0, 6.29, 99)), np.sin(a)]
)
axes[1].plot(
    *estimate[:, 1:].T, ".", *(truth[1:, None] + circle), "k-", *truth[1:, None], "k*"
)
axes[1].set(aspect="equal", xlabel="principal point x, px", ylabel="y, px")
print("intervals that contain the truth (focal, x, y):", np.round(inside.mean(axis=0), 2))
rms, predicted = np.sqrt(np.mean(residual**2)), sigma * np.sqrt(1 - d / N)
print(f"RMS residual {rms:.4f} px, predicted {predicted:.4f} px")
