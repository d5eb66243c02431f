r"""
1. Corners and matches
======================

A reconstruction begins with points that can be found again in other images (chapter 4 of the thesis). A patch
on an edge looks like its neighbours along the edge, so it cannot be located: the aperture problem. At a
:term:`corner` the image changes in every direction. With the gradient :math:`(I_x, I_y)` and a Gaussian
window :math:`w`, the change of a patch under a small shift :math:`d` is about :math:`d^\top M d` (4.2.1),

.. math:: M = \sum w \begin{pmatrix} I_x^2 & I_x I_y \\ I_x I_y & I_y^2 \end{pmatrix}, \quad
   R = \det M / \operatorname{tr} M.

:math:`R` is large only if both eigenvalues of :math:`M` are large, that is at corners.
"""

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

import thesisrecon

folder = thesisrecon.sample("courtyard") / "images"
paths = [folder / "0000.jpg", folder / "0001.jpg"]
left, right = (np.asarray(Image.open(path)) for path in paths)
crop = np.s_[300:440, 180:360]
Iy, Ix = np.gradient(gaussian_filter(left.mean(axis=2), 1.0))
Mxx, Mxy, Myy = (gaussian_filter(product, 1.5) for product in (Ix * Ix, Ix * Iy, Iy * Iy))
R = (Mxx * Myy - Mxy**2) / (Mxx + Myy + 1e-9)
image = thesisrecon.Image("0000.jpg", left, (1024, 768))
corners = thesisrecon.PipelineConfig().features.detect(image)
inside = corners.xy - (180, 300)
inside = inside[((inside > 0) & (inside < (180, 140))).all(axis=1)]
figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
axes[0].imshow(left[crop])
axes[1].imshow(Mxx[crop] + Myy[crop], cmap="magma")
axes[2].imshow(np.sqrt(np.maximum(R[crop], 0)), cmap="magma")
axes[2].plot(*inside.T, "c.", markersize=4)
titles = "image", "tr M: edges and corners", "R, and the corners kept"
for axis, title in zip(axes, titles, strict=True):
    axis.set(title=title, xticks=[], yticks=[])

# %%
# Corners of two images are compared by the correlation of their patches (4.2.2). Many patches look alike, so
# a :term:`match` must also agree with its neighbours, which should move alike (4.1). The default method grows
# matches around reliable ones. *Verified* matches obey one epipolar geometry, the subject of the next page.

pair = thesisrecon.match_pair(*paths)
shown = pair.xy1[:, 1].argsort()[:: len(pair.xy1) // 60]
figure, axis = plt.subplots(figsize=(12, 4.6), layout="constrained")
axis.imshow(np.hstack([left, right]))
ends = np.stack([pair.xy1[shown], pair.xy2[shown] + (1024, 0)])
axis.plot(ends[..., 0], ends[..., 1], linewidth=0.8, marker=".", markersize=4)
title = f"{pair.inliers} matches of {len(corners.xy)} corners; 60 of them"
axis.set(title=title, xticks=[], yticks=[])
print(
    f"{pair.candidates} candidates, {pair.inliers} verified, noise {pair.sigma_px:.2f} px"
)
