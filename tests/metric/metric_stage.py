"""Scenes, the metric stage on them, and how far its cameras are off."""

from dataclasses import replace

import numpy as np

from tests.synthetic import projective_reconstruction
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.bundle.scatter import BlockScatter
from thesisrecon.records import SelfCalibration, Upgrade
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement


def true_calibration(scene):
    """The truth as an upgrade of ``projective_reconstruction``, focals 2 % off."""
    G = np.eye(4) + 0.3 * np.random.default_rng(0).normal(size=(4, 4))
    K = scene.K * np.array([1.02, 1.02, 1.0])[:, None]
    K[:, :2, 2] = (scene.sizes - 1) / 2
    upgrade = Upgrade(np.linalg.inv(G), K, 0.0, "truth")
    return SelfCalibration(upgrade.metric_from_projective, K, np.zeros_like(K), True, (), (upgrade,))


def refine(scene, *, start=None, **options):
    start = projective_reconstruction(scene) if start is None else start
    rng, prior = np.random.default_rng(0), prior_for(start, IntrinsicsOptions(**options))
    return MetricRefinement().refine(start, true_calibration(scene), prior=prior, rng=rng)


def with_few_points(scene, view, count):
    """The scene with ``count`` observations left in one view."""
    t = scene.tracks
    keep = np.ones(len(t.xy), dtype=bool)
    keep[np.flatnonzero(t.view_index == view)[count:]] = False
    fields = {name: getattr(t, name)[keep] for name in ("view_index", "point_index", "xy")}
    return replace(scene, tracks=replace(t, **fields))


def run(scene, *, shared=True, reconstruction=None, options=None):
    start = projective_reconstruction(scene) if reconstruction is None else reconstruction
    prior = prior_for(start, options or IntrinsicsOptions(cameras="shared" if shared else "per-image"))
    rng = np.random.default_rng(0)
    calibration = HypothesesAndRefinement().calibrate(start, prior=prior, rng=rng)
    return MetricRefinement().refine(start, calibration, prior=prior, rng=rng)


def centre_error(result, scene):
    """Mean camera-centre error after similarity alignment, in units of the cameras' mutual distance."""
    views = result.reconstruction.registered
    C = camera_centre(result.reconstruction.P[views])
    C = C[:, :3] / C[:, 3:]
    moved = estimate_similarity(C, scene.centres[views]).apply(C)
    spread = np.linalg.norm(scene.centres - scene.centres.mean(axis=0), axis=1).mean()
    return float(np.linalg.norm(moved - scene.centres[views], axis=1).mean() / spread)


def with_xy(scene, xy):
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


def scatter(contradiction, blocks=32):
    """Variances and ratios of one, with so much contradiction between the blocks."""
    one = np.ones((1, 8))
    return BlockScatter(
        one, np.ones(8), one, one, np.full((2, 1, 2), np.nan), 0.0 * one, 0.0 * one, contradiction, blocks
    )
