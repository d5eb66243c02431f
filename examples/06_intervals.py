r"""
6. Bundle adjustment and its intervals against the truth
========================================================

:term:`Bundle adjustment <bundle adjustment>` (6.7; HZ 18.1) moves all cameras and points together until the
images are explained best,

.. math:: \min \sum_{ij} \| x_{ij} - \hat x_{ij} \|^2, \qquad \hat x_{ij} \simeq P_i X_j,

the maximum likelihood estimate for normal noise, and its precision is known. With the derivatives :math:`J`
of the residuals by the unknowns, the :term:`covariance` of these is :math:`\Sigma = \sigma^2 (J^\top J)^+`
(HZ 5.2): the pseudo-inverse, because the frame and the scale of the world (the :term:`gauge`, seven numbers)
change no image. An interval of :math:`\pm 1.96` :term:`standard deviations <standard deviation>` should
contain the truth in 95 of 100 cases. With :math:`N` observed coordinates and :math:`d` unknowns (without the
seven: -7 in the code) the RMS residual should be :math:`\sigma\sqrt{1 - d/N}`, less than the noise (HZ result
5.2). Both are tested in 100 trials with new noise. Left: the focal lengths with intervals, sorted. Right: the
principal points and the ellipse predicted for 95 % of them (mean covariance, :math:`\chi^2 = 5.99`).
"""

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

cube = np.load(thesisrecon.sample("cube") / "cube.npz")
views = np.flatnonzero(np.isfinite(cube["xy"][..., 0]).sum(axis=1) > 200)[::2]
exact, K = cube["xy"][views], cube["K"]
R, C, sigma = cube["R"][views], cube["C"][views], 0.5
t, rng, trials = -np.einsum("vij,vj->vi", R, C), np.random.default_rng(0), 100
start = K @ np.diag([1.1, 1.1, 1.0]), R, t
options = {"sizes": (800, 600), "free": ("focal", "principal_point"), "loss": "squared"}
estimate, std = np.zeros((2, trials, 3))
residual, covariance = np.zeros(trials), 0.0
for i in range(trials):
    xy = exact + rng.normal(0, sigma, exact.shape)
    X = cube["X"] + rng.normal(0, 0.05, cube["X"].shape)
    found = thesisrecon.bundle_adjust(start, X, xy, **options)
    camera = found.cameras[0]
    estimate[i] = camera.K[0, 0], camera.K[0, 2], camera.K[1, 2]
    std[i] = [camera.std[name] for name in ("focal_px", "principal_x_px", "principal_y_px")]
    residual[i] = np.sqrt(np.nanmean(found.residual_px**2))
    covariance = covariance + found.intrinsics_covariance[0][3:5, 3:5] / trials
truth = K[[0, 0, 1], [0, 2, 2]]
inside, order = np.abs(estimate - truth) < 1.96 * std, estimate[:, 0].argsort()
N, d = 2 * np.isfinite(exact[..., 0]).sum(), 6 * len(views) + 3 * len(X) + 3 - 7
figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
colours = np.where(inside[order, 0], "tab:blue", "tab:red")
focal, half = estimate[order, 0], 1.96 * std[order, 0]
axes[0].errorbar(range(trials), focal, half, fmt="none", ecolor=colours)
axes[0].axhline(truth[0], color="k", linestyle="--")
axes[0].set(xlabel="trial", ylabel="focal length, px")
a = np.linspace(0, 6.29, 99)
ellipse = np.linalg.cholesky(5.99 * covariance) @ (np.cos(a), np.sin(a)) + truth[1:, None]
axes[1].plot(*estimate[:, 1:].T, ".", *ellipse, "k-", *truth[1:], "k*")
axes[1].set(aspect="equal", xlabel="principal point x, px", ylabel="y, px")
print("intervals that contain the truth (focal, x, y):", np.round(inside.mean(axis=0), 2))
rms, predicted = np.sqrt(np.mean(residual**2)), sigma * np.sqrt(1 - d / N)
print(f"RMS residual {rms:.4f} px, predicted {predicted:.4f} px")
