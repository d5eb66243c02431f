r"""
5. A critical motion and how it is named
========================================

After some motions no method can find the calibration. A camera with the calibration :math:`K`, the rotation
:math:`R` and the centre :math:`C` has the matrix :math:`P = K R\,[I \; {-C}]`. If it only translates,
:math:`R = I`, then for any other calibration :math:`K'`, with the affine map :math:`A = K'^{-1} K`,

.. math:: K\,(X - C_i) = K' (A X - A C_i):

a camera :math:`K'` that translates through the sheared or stretched scene :math:`A X` has the same images. So
a translation leaves depth and focal length undetermined: a :term:`critical motion` (Sturm 1997; HZ 19.3.5,
19.5.3). Others are rotations about the optical axis, and turntables (HZ 19.9) unless pixels are square.

Below, the focal length is fixed at wrong values, and all else is adjusted to images with noise of 0.5 px. If
the RMS residual does not rise, the images do not contradict them. The library names the motion and advises.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon

rng, n, size = np.random.default_rng(0), 8, (800, 600)
K = np.array([[800.0, 0, 399.5], [0, 800, 299.5], [0, 0, 1]])
X, I = rng.uniform(-1, 1, (150, 3)), np.tile(np.eye(3), (n, 1, 1))
side, angle = np.linspace(-1, 1, n), np.linspace(-60, 60, n)
around = Rotation.from_euler("y", angle[:, None], degrees=True).as_matrix()
angles = np.c_[20 * np.cos(3 * side), angle, 30 * side]
nodding = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
rolling = Rotation.from_euler("z", 30 * side[:, None], degrees=True).as_matrix()
sideways = np.c_[-side, rng.uniform(-0.4, 0.4, n), rng.uniform(3.6, 4.4, n)]
motions = {
    "general": (nodding, np.tile([0, 0, 4.0], (n, 1)) + rng.uniform(-0.3, 0.3, (n, 3))),
    "turntable": (around, np.tile([0, 0, 4.0], (n, 1))),
    "translation": (I, sideways),
    "rotation about the optical axis": (rolling, (rolling @ sideways[..., None])[..., 0]),
}

focals = np.array([400, 500, 600, 700, 800, 900, 1000, 1200, 1600.0])
figure, axis = plt.subplots(figsize=(8, 4.2), layout="constrained")
for name, (R, t) in motions.items():
    cameras = [thesisrecon.Camera(K, *pose, size) for pose in zip(R, t, strict=True)]
    xy = np.stack([c.project(X) for c in cameras]) + rng.normal(0, 0.5, (n, len(X), 2))
    xy[((xy < 0) | (xy > (799, 599))).any(axis=2)] = np.nan
    rms = []
    for focal in focals:
        wrong = np.array([[focal, 0, 399.5], [0, focal, 299.5], [0, 0, 1]])
        adjusted = thesisrecon.bundle_adjust((wrong, R, t), X, xy, sizes=size, free=())
        rms.append(np.sqrt(np.nanmean(adjusted.residual_px**2)))
    axis.loglog(focals, rms, "o-", label=name)
    found = thesisrecon.self_calibrate(np.stack([c.P for c in cameras]), size, xy=xy)
    reasons = "; ".join(found.identifiability.sentences)
    print(f"{name}: determined {found.identifiable}. {reasons}")
axis.set(xlabel="assumed focal length, px (truth 800)", ylabel="RMS residual, px")
axis.set_xticks(focals[::2], focals[::2].astype(int))
axis.set_yticks([0.5, 1, 2, 5], [0.5, 1, 2, 5])
axis.minorticks_off()
axis.legend()
