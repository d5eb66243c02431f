r"""
7. Rectification and disparity
==============================

The match of a pixel lies on its :term:`epipolar line`. If both images are warped so that corresponding
epipolar lines become the same row (:term:`rectification`), the search runs along rows (section 2.5). The
remaining shift :math:`d = x_l - x_r` is the :term:`disparity`; for parallel cameras with baseline :math:`b`,
:math:`d = f b / Z`: near points move more. Only :math:`F` and the matches are needed, no calibration.
"""

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import thesisrecon

folder = thesisrecon.sample("courtyard")
names = ["0010.jpg", "0011.jpg"]
images = [np.asarray(Image.open(folder / "images" / name).reduce(2)) for name in names]
pair = thesisrecon.match_pair(*images)
rectified = thesisrecon.rectify(*images, pair.F, pair.xy1, pair.xy2, planar=True)
left, right, limit = rectified.left, rectified.right, rectified.max_disparity_px
points = pair.xy1, pair.xy2
rows = [rectified.rectified_from_original(k, points[k])[:, 1] for k in (0, 1)]
rms = np.sqrt(np.mean((rows[0] - rows[1]) ** 2))
print(f"rows of the matches differ by {rms:.3f} px (RMS)")
figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained", sharey=True)
for axis, image in zip(axes, (left, right), strict=True):
    axis.imshow(np.nan_to_num(image, nan=255).astype(np.uint8))
    axis.hlines(range(40, len(image), 80), 0, image.shape[1] - 1, "yellow", linewidth=0.8)

# %%
# Pixel by pixel there are too many false matches, so neighbouring pixels are matched together. The thesis
# uses dynamic programming: the most likely sequence of matches and occlusions of a row, in one order (Cox et
# al. 1996). The default sums the costs of such paths in several directions (semi-global matching). Pixels are
# unknown where left to right and right to left disagree. Both are compared with the true disparities.

depth = np.asarray(Image.open(folder / "depth" / "0010.png")) * 0.00025
cameras = thesisrecon.read_cameras(folder / "cameras.json")
first, second = (cameras[name].scaled(0.5) for name in names)
row, column = np.indices(left.shape[:2])
pixels = np.stack([column.ravel(), row.ravel()], axis=1).astype(float)
xy = rectified.original_from_rectified(0, pixels)
x, y = np.clip(np.rint(xy), 0, (511, 383)).astype(int).T
seen = (np.abs(xy - (255.5, 191.5)) < (256, 192)).all(axis=1) & (depth[y, x] > 0)
scene = first.unproject(xy, np.where(seen, depth[y, x], np.nan))
moved = rectified.rectified_from_original(1, second.project(scene))
truth = (pixels[:, 0] - moved[:, 0]).reshape(row.shape)
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
axes[0].imshow(truth, vmin=0, vmax=limit)
axes[0].set(title="truth, also of hidden pixels")
for axis, preset in zip(axes[1:], ("thesis", "default"), strict=True):
    found = thesisrecon.match_rectified(left, right, max_disparity_px=limit, config=preset)
    axis.imshow(found.disparity, vmin=0, vmax=limit)
    error = np.abs(found.disparity - truth)
    error = error[np.isfinite(error)]
    known, wrong = error.size / np.isfinite(truth).sum(), np.mean(error > 1)
    axis.set(title=f"{preset}: {known:.0%} known, {wrong:.0%} wrong")
