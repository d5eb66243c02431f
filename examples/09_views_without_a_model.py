r"""
9. New views without a model
============================

Two images and their dense matches are enough for new views; no surface is built (chapter 1 of the thesis).
*Interpolation* (Seitz and Dyer 1995): if both images are rectified, a pixel at :math:`x` with disparity
:math:`d` moves to :math:`x - s d`. Because the rectified cameras are parallel, this is exactly the image in
the camera :math:`P_s = (1 - s) P_0 + s P_1` on the :term:`baseline`. Finally the rectification is undone.
"""

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import thesisrecon
from thesisrecon.api.views import prepare_pair, prepare_trilinear_views
from thesisrecon.views.tensor import VirtualCamera

folder = thesisrecon.sample("courtyard")
names = ["0005.jpg", "0007.jpg", "0006.jpg"]
images = [np.asarray(Image.open(folder / "images" / name).reduce(2)) for name in names]
first, second, real = images
pair = prepare_pair(first, second)
figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
for axis, s in zip(axes, (0.0, 0.5, 1.0), strict=True):
    axis.imshow(pair.view(s))
    axis.set(title=f"s = {s:g}" + ("" if s % 1 else " (image)"), xticks=[], yticks=[])

# %%
# The *trilinear tensor* (:term:`trifocal tensor`) gives views off the baseline (Avidan and Shashua 1997). It
# relates the pixels of a point in the cameras :math:`[I \; 0]`, :math:`[a \; a_4]` and :math:`[b \; b_4]`
# (HZ 15.1; indices that occur twice are summed):
#
# .. math:: T_i^{jk} = a_i^j b_4^k - a_4^j b_i^k, \qquad {x''}^k = x^i\, l'_j\, T_i^{jk},
#
# with any line :math:`l'` through :math:`x'` but the epipolar line: the third image follows from the other
# two. Two images alone give the seed :math:`b = a`; a motion :math:`(R, t)` of the third camera turns it into
# :math:`{T'}_i^{jk} = R^k_l T_i^{jl} + t^k a_i^j`. Here the virtual camera is moved to where image 0006 was
# really taken, so that the errors can be seen, and then up and back.

cameras = thesisrecon.read_cameras(folder / "cameras.json")
one, two, three = (cameras[name].scaled(0.5) for name in names)
views = prepare_trilinear_views(first, second, K=two.K)
R = three.R @ two.R.T
t = (three.t - R @ two.t) / np.linalg.norm(one.centre - two.centre)
there = views.render(VirtualCamera(R, t, three.K, three.size))
beside = views.render(VirtualCamera(R, t + np.array([0, 0.4, 0.4]), three.K, three.size))
figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
psnr = 10 * np.log10(255**2 / np.mean((there.astype(float) - real) ** 2))
titles = (
    "image 0006, not used",
    f"the tensor's view from there, {psnr:.1f} dB",
    "0.4 baselines up and back",
)
for axis, image, title in zip(axes, (real, there, beside), titles, strict=True):
    axis.imshow(image)
    axis.set(title=title, xticks=[], yticks=[])
