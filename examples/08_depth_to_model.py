r"""
8. From depth to a textured model
=================================

With calibrated cameras a disparity becomes a depth, and each image gets a :term:`depth map` (section 2.6):
for every pixel :math:`x` the depth :math:`Z` along the optical axis, so that
:math:`X = C + Z R^\top K^{-1} x` lies on the surface. Several neighbouring images are matched and their
depths combined, each pixel is refined with a small plane through its surface point, and depths that no other
view confirms are removed. The cameras here are the true ones of the courtyard, so that all errors are those
of the depths; ``thesisrecon.load(out).cameras`` gives estimated ones.
"""

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import thesisrecon

folder = thesisrecon.sample("courtyard")
paths = [folder / "images" / f"{i:04d}.jpg" for i in range(3, 7)]
all_cameras = thesisrecon.read_cameras(folder / "cameras.json")
cameras = [all_cameras[path.name] for path in paths]
maps = thesisrecon.depth_maps(paths, cameras, max_size=256, depth_range=(2, 12), threads=2)
depth = maps[1].depth
true = np.asarray(Image.open(folder / "depth" / "0004.png"))[1::2, 1::2] * 0.00025
error = 100 * np.abs(depth / np.where(true > 0, true, np.nan) - 1)
figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
axes[0].imshow(Image.open(paths[1]))
for axis, values, title, most in (
    (axes[1], depth, "depth, m", 9),
    (axes[2], error, "error, %", 1),
):
    figure.colorbar(axis.imshow(values, vmin=0, vmax=most), ax=axis, label=title)
within = np.mean(error[np.isfinite(error)] < 1)
known, median = np.isfinite(depth).mean(), np.nanmedian(error)
print(f"{known:.0%} of the pixels have a depth; median error {median:.2f} %")
print(f"{within:.1%} of them within 1 %")

# %%
# The maps are fused to one surface in a grid of signed distances: each map says how far a grid point is in
# front of or behind its surface, and the mesh is where the average distance is zero. Its texture is blended
# from the images that show it. The model can then be rendered from anywhere: below from the camera of an
# image that was not used, beside that image, and from a point above. Parts that no camera saw stay empty.

mesh = thesisrecon.texture(thesisrecon.fuse_depth_maps(maps), paths, cameras, max_size=512)
unused = all_cameras["0007.jpg"].scaled(0.5)
up = thesisrecon.Camera(unused.K, unused.R, unused.t + np.array([0, 1.2, 0.5]), unused.size)
figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
axes[0].imshow(Image.open(folder / "images" / "0007.jpg"))
axes[1].imshow(thesisrecon.render(mesh, unused).color)
axes[2].imshow(thesisrecon.render(mesh, up).color)
for axis, title in zip(
    axes, ("image 0007, not used", "the model from there", "and from above"), strict=True
):
    axis.set(title=title, xticks=[], yticks=[])
print(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")
# thesisrecon.write_mesh("model.glb", mesh) saves the model, mesh.show() turns it in a notebook.
