"""The demo as on other processors: what is the same, and by how much the rest differs. `-s` prints it."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.processors import NATIVE, environment, processors
from thesisrecon import load
from thesisrecon.api.models import compare_models

RUN = """
import sys
from thesisrecon import reconstruct
from thesisrecon.io._images import demo_images
reconstruct(demo_images(), sys.argv[1], until="metric", max_size=480, threads=1)
"""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(len(processors()) == 1, reason="this processor acts as no other"),
]


def _python(processor, code, *arguments):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment(processor), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processors")
    for name in processors():
        _python(name, RUN, folder / name)
    return {name: load(folder / name) for name in processors()}


def _observed(run):
    """View and pixel of each used observation (K, 3), views far apart, and the image of its point (K, 2)."""
    model = run.best_reconstruction
    view, point, xy = (
        getattr(model.tracks, name)[model.used] for name in ("view_index", "point_index", "xy")
    )
    image = np.einsum("kab,kb->ka", model.P[view], model.X[point])
    return np.column_stack([1e5 * view, xy]), image[:, :2] / image[:, 2:]


def test_the_demo_differs_between_processors_by_rounding_only(runs):
    b = runs[NATIVE]
    seen_b, image_b = _observed(b)
    sigma = b.best_reconstruction.sigma_px
    for name in set(runs) - {NATIVE}:
        a = runs[name]
        seen, image = _observed(a)
        apart, nearest = cKDTree(seen_b).query(seen)
        same = apart < 0.01
        found = compare_models(a, b)
        focal, distance = (
            b.cameras[0].K[0, 0],
            np.median(np.linalg.norm(b.points - b.cameras[0].centre, axis=1)),
        )
        largest = {
            "share of observations": same.mean() * min(1.0, len(seen) / len(seen_b)),
            "corners, px": apart[same].max(),
            "images of the points, px": np.linalg.norm(image - image_b[nearest], axis=1)[same].max(),
            "centres, px": found.centre_error.max() * focal / distance,
            "rotations, px": np.radians(found.rotation_error_deg.max()) * focal,
            "focal length, px": np.abs(found.focal_error_rel).max() * focal,
            "intrinsics, standard deviations": max(
                abs(x[key]["value"] - y[key]["value"]) / y[key]["std"]
                for x, y in zip(a.summary["cameras"], b.summary["cameras"], strict=True)
                for key in ("focal_px", "principal_x_px", "principal_y_px", "k1", "k2", "k3")
            ),
        }
        print(name, *(f"{what}: {value:.2g}" for what, value in largest.items()), sep="\n  ")
        assert largest["share of observations"] >= 0.999
        # Corners are iterated to 0.001 px; models follow them, far below the noise of the images.
        assert largest["corners, px"] < 1e-3
        assert largest["images of the points, px"] < 0.1 * sigma
        assert max(largest[what] for what in ("centres, px", "rotations, px")) < 0.1 * sigma
        assert largest["intrinsics, standard deviations"] < 0.01
