r"""
2. Epipolar geometry and its precision
======================================

Pixels are written in :term:`homogeneous coordinates`, :math:`x = (x, y, 1)^\top`, equal up to scale; a line
is a vector :math:`l` of three numbers with :math:`l^\top x = 0`. Image 2 sees the ray of a point :math:`x_1`
of image 1 as a line, the :term:`epipolar line`, and the match :math:`x_2` must lie on it. One matrix gives
all these lines, the :term:`fundamental matrix` (3.34; HZ 9.2):

.. math:: x_2^\top F\, x_1 = 0, \qquad l_2 = F x_1, \qquad \det F = 0.

The lines meet in the :term:`epipole`, the image of the other camera's centre. :math:`F` has nine entries, no
scale and rank 2: seven degrees of freedom. Seven matches determine it up to three solutions (5.2), more make
it unique and precise. No calibration is needed.
"""

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

folder = thesisrecon.sample("courtyard")
paths = [folder / "images" / name for name in ("0000.jpg", "0001.jpg")]
pair = thesisrecon.match_pair(*paths)
fit = thesisrecon.estimate_fundamental(pair.xy1, pair.xy2)
some = np.random.default_rng(0).choice(len(pair.xy1), 12, replace=False)
figure, axes = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
images = thesisrecon.draw_epipolar_lines(*paths, fit.F, pair.xy1[some], pair.xy2[some])
for axis, image in zip(axes, images, strict=True):
    axis.imshow(image)
    axis.set(xticks=[], yticks=[])

# %%
# How precise is :math:`F`? Each distance has the noise of both images, a variance of :math:`2\sigma^2`, and a
# fit of 7 parameters to :math:`n` of them has 7/n of it on average. No unbiased estimate can bring the RMS
# distance of exact points below about :math:`\sigma\sqrt{14/n}` (:term:`bound`; for many matches). The
# eight-point method (5.1) is linear; the :term:`gold standard` minimises distances in the images (HZ 11.4.1).

cube = np.load(thesisrecon.sample("cube") / "cube.npz")
exact = cube["xy"][[13, 22]][:, np.isfinite(cube["xy"][[13, 22]]).all(axis=(0, 2))]
rng, sigma, counts = np.random.default_rng(1), 1.0, [20, 40, 80, 160, 320]
figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
for method in ("eight-point", "gold-standard"):
    errors = np.zeros((len(counts), 40))
    for i, trial in np.ndindex(errors.shape):
        chosen = rng.choice(exact.shape[1], counts[i], replace=False)
        noisy = exact[:, chosen] + rng.normal(0, sigma, (2, counts[i], 2))
        F = thesisrecon.estimate_fundamental(*noisy, method=method).F
        lines = thesisrecon.epipolar_lines(F, exact[0])
        distances = np.sum(lines[:, :2] * exact[1], axis=1) + lines[:, 2]
        errors[i, trial] = np.sqrt(np.mean(distances**2))
    axis.loglog(counts, np.sqrt(np.mean(errors**2, axis=1)), "o-", label=method)
bound = sigma * np.sqrt(14 / np.array(counts))
axis.loglog(counts, bound, "k--", label=r"$\sigma\sqrt{14/n}$")
axis.set(title="noise 1 px", xlabel="matches n", ylabel="distance to epipolar lines, px")
axis.set_xticks(counts, counts)
axis.minorticks_off()
axis.legend()
