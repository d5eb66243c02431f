"""A stage with one method for each reference library, through its adapter, on a few points."""

import numpy as np

from thesisrecon.records import TexturedMesh
from validation.references.fundamental import estimate_with
from validation.references.open3d_geometry import Nearest
from validation.references.triangulation import colmap_points, opencv_linear
from validation.runs.records import Judgement
from validation.runs.tables import Metric

METHODS = ("cv2", "pycolmap", "poselib", "open3d")


class ReferenceStage:
    """Scenes are called after the methods that run on them."""

    name = "references"
    title = "References"
    definition = "Whether each answers."

    def takes(self, scene, options):
        return True

    def methods(self, scene, options):
        return tuple(scene.split("-"))

    def needs(self, method):
        return ()

    def run(self, task, options):
        rng = np.random.default_rng(0)
        P = np.stack([np.eye(3, 4), np.eye(3, 4)])
        P[1, 0, 3] = -1.0
        X = rng.uniform(1.0, 4.0, (40, 3))
        xy = np.stack([X[:, :2], X[:, :2] - [1.0, 0.0]]) / X[:, 2:]
        if task.method == "cv2":
            opencv_linear(P, xy)
        if task.method == "pycolmap":
            colmap_points(P, xy)
        if task.method == "poselib":
            estimate_with("PoseLib", 100.0 * xy[0], 100.0 * xy[1], threshold_px=1.0, seed=0)
        if task.method == "open3d":
            Nearest(TexturedMesh(np.eye(3), np.array([[0, 1, 2]]))).distances(X)

    def judge(self, scene, outcomes, options):
        values = {name: 1.0 if o.ok else None for name, o in outcomes.items()}
        return Judgement([Metric(scene, "answers", "", values, next(iter(values)))])


STAGES = {"references": ReferenceStage()}
