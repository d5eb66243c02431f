"""Chapter 7 on real images: every method for the plane at infinity and both methods from it to K, in closed
form and refined.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.records import Image, Reconstruction
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.cheirality import CheiralitySearch
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.parallel_lines import ParallelLines
from thesisrecon.selfcalibration.stratified import Stratified
from validation.scenes.real import REAL_SCENES
from validation.studies.coverage import Cameras
from validation.studies.runner import Part, scenes_here, text_table

PLANES: Mapping[str, CheiralitySearch | ModulusConstraint | ParallelLines] = {
    "cheirality, grid alone": CheiralitySearch(refine_iterations=0),
    "cheirality search": CheiralitySearch(),
    "modulus constraint": ModulusConstraint(),
    "parallel lines": ParallelLines(),
    "parallel lines, right angles": ParallelLines(orthogonal_directions=True),
}
K_METHODS: dict[str, LinearAbsoluteConic | FixedPlaneQuadric] = {
    "Hartley": LinearAbsoluteConic(),
    "Pollefeys": FixedPlaneQuadric(),
}


@dataclass(frozen=True)
class Row:
    """One method on one image set.

    ``focal_pct``: focal error, median over the views; ``principal_px``: error of the principal point;
    ``refusal``: reason of a refusal.
    """

    plane: str
    k_method: str
    refined: bool
    focal_pct: float
    principal_px: float
    seconds: float
    refusal: str = ""


def measure_stratified(
    projective: Reconstruction, images: Sequence[Image], K: F64, *, cameras: Cameras = "shared"
) -> Iterator[Row]:
    """Run every stratified method on one set, against K (V, 3, 3) at working size."""
    prior = prior_for(projective, IntrinsicsOptions(cameras=cameras))
    views = np.flatnonzero(projective.registered)
    for plane_name, plane in PLANES.items():
        for k_name, k_method in K_METHODS.items():
            for refined in (False, True):
                variant = Stratified(plane, k_method, refine=refined).with_images(images)
                start = time.perf_counter()
                head = (plane_name, k_name, refined)
                try:
                    answer = variant.calibrate(projective, prior=prior, rng=np.random.default_rng(0))
                except StageFailure as failure:
                    yield Row(*head, np.nan, np.nan, time.perf_counter() - start, failure.reason)
                    continue
                focal = 100.0 * np.abs(answer.K[views, 0, 0] / K[views, 0, 0] - 1.0)
                principal = np.linalg.norm(answer.K[views, :2, 2] - K[views, :2, 2], axis=1)
                seconds = time.perf_counter() - start
                yield Row(*head, float(np.median(focal)), float(np.median(principal)), seconds)


def stratified_table(name: str, rows: Sequence[Row]) -> str:
    """Return focal errors in closed form and refined, the refined principal point and the time."""
    cells = []
    for closed, refined in zip(rows[::2], rows[1::2], strict=True):
        numbers = [f"{row.focal_pct:.3f} %" if not row.refusal else "refused" for row in (closed, refined)]
        principal = f"{refined.principal_px:.1f} px" if not refined.refusal else refined.refusal
        cells.append([closed.plane, closed.k_method, *numbers, principal, f"{closed.seconds:.1f}"])
    head = [name, "method for K", "focal, closed form", "focal, refined", "principal point, refined", "s"]
    return text_table(head, cells)


def stratified_study(
    out: Path,
    scenes: Sequence[str] = ("courtyard", *REAL_SCENES),
    cameras: Cameras = "shared",
) -> Iterator[Part]:
    """Compare the stratified methods alone on real images.

    Without truth, the metric result of the default pipeline stands in.
    """
    for scene in scenes_here(scenes):
        run = thesisrecon.reconstruct(scene.image_paths[0].parent, out / scene.name, until="metric")
        assert run.projective is not None
        assert run.metric is not None
        K = run.metric.reconstruction.K if scene.K is None else scene.K
        assert K is not None
        rows = list(measure_stratified(run.projective, run.images, K, cameras=cameras))
        yield stratified_table(scene.name, rows)
