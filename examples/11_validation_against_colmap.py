r"""
11. Validation against COLMAP
=============================

Is the result right, and how does it compare with the best programs? Six images of the courtyard at 640 px are
reconstructed by this library and by COLMAP (the package ``pycolmap``, which the extras ``docs`` and
``validation`` install; without it its bars are missing). Neither gets any calibration: no EXIF, no focal
length. The models are compared with the truth after the :term:`similarity` that aligns the camera centres
best, because images determine no world frame (3.4.4).
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import thesisrecon

try:
    import pycolmap
except ImportError:
    pycolmap = None
    print("pycolmap is not installed (extra docs): no comparison with COLMAP")
folder = thesisrecon.sample("courtyard")
images = sorted((folder / "images").glob("*.jpg"))[:6]
with TemporaryDirectory() as temporary:
    out = Path(temporary)
    ours = thesisrecon.reconstruct(images, out / "ours", max_size=640, until="metric")
    models, truth = {"thesisrecon": ours.out}, folder / "cameras.json"
    if pycolmap is not None:
        # SIFT, all pairs, incremental mapping; one camera with its principal point refined.
        pycolmap.logging.minloglevel = 2
        place, single = (out / "db", images[0].parent), pycolmap.CameraMode.SINGLE
        options = pycolmap.FeatureExtractionOptions(max_image_size=640)
        names = [image.name for image in images]
        pycolmap.extract_features(*place, names, single, extraction_options=options)
        pycolmap.match_exhaustive(out / "db")
        options = pycolmap.IncrementalPipelineOptions(ba_refine_principal_point=True)
        pycolmap.incremental_mapping(*place, out, options)
        models["COLMAP"] = out / "0"
    found = {name: thesisrecon.compare_models(m, truth) for name, m in models.items()}

# %%
# One scene proves little: this one is rendered, sharp and small. The pages of evidence compare each stage
# with its best reference on rendered and on real scenes, at full size, and say where the references win.

figure, axes = plt.subplots(1, 2, figsize=(12, 3.6), layout="constrained")
for k, (name, comparison) in enumerate(found.items()):
    place = np.arange(len(comparison.names)) + 0.4 * k
    axes[0].bar(place, 1000 * comparison.centre_error, 0.4, label=name)
    axes[1].bar(place, comparison.rotation_error_deg, 0.4, label=name)
    focal = 100 * comparison.focal_error_rel.mean()
    principal = comparison.principal_point_error_px.mean()
    print(
        f"{name}: focal length off by {focal:.3f} %, principal point by {principal:.2f} px"
    )
axes[0].set(xlabel="image", ylabel="error of the camera centre, mm")
axes[1].set(xlabel="image", ylabel="error of the rotation, degrees")
axes[1].legend()
