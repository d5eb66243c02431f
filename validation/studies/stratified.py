"""Each stratified method alone on photographs: focal error in closed form and after its refinement.

`python -m validation.studies.stratified -o FOLDER [NAME ...]` reconstructs the named sets (a folder that holds
them already is resumed) and calibrates their projective stratum by every way to the plane at infinity and
both ways from it to K. Sets without truth are held against the metric result of the default pipeline.
"""

from __future__ import annotations

import argparse
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
from thesisrecon.selfcalibration.cheirality import CheiralitySearch
from thesisrecon.selfcalibration.hartley import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.parallel_lines import ParallelLines
from thesisrecon.selfcalibration.stratified import Stratified
from validation.scenes.real import REAL_SCENES, load_fixture_scene, load_real_scene

PLANES: Mapping[str, CheiralitySearch | ModulusConstraint | ParallelLines] = {
    "cheirality, grid alone": CheiralitySearch(refine_iterations=0),
    "cheirality search": CheiralitySearch(),
    "modulus constraint": ModulusConstraint(),
    "parallel lines": ParallelLines(),
    "parallel lines, right angles": ParallelLines(orthogonal_directions=True),
}
WAYS: dict[str, LinearAbsoluteConic | FixedPlaneQuadric] = {
    "Hartley": LinearAbsoluteConic(),
    "Pollefeys": FixedPlaneQuadric(),
}


@dataclass(frozen=True)
class Row:
    """One method on one set: ``focal_pct`` error of the focal (median over the views), ``principal_px`` of
    the principal point; ``refusal`` where there is none."""

    plane: str
    way: str
    refined: bool
    focal_pct: float
    principal_px: float
    seconds: float
    refusal: str = ""


def measure(
    projective: Reconstruction, photographs: Sequence[Image], K: F64, *, cameras: str = "shared"
) -> Iterator[Row]:
    """Every method on one set, against the calibrations K (V, 3, 3) at working size."""
    wish = IntrinsicsOptions(cameras="per-image" if cameras == "per-image" else "shared")
    prior = prior_for(projective, wish)
    views = np.flatnonzero(projective.registered)
    for plane_name, plane in PLANES.items():
        for way_name, way in WAYS.items():
            for refined in (False, True):
                variant = Stratified(plane, way, refine=refined).with_images(photographs)
                start = time.perf_counter()
                head = (plane_name, way_name, refined)
                try:
                    answer = variant.calibrate(projective, prior=prior, rng=np.random.default_rng(0))
                except StageFailure as failure:
                    yield Row(*head, np.nan, np.nan, time.perf_counter() - start, failure.reason)
                    continue
                focal = 100.0 * np.abs(answer.K[views, 0, 0] / K[views, 0, 0] - 1.0)
                principal = np.linalg.norm(answer.K[views, :2, 2] - K[views, :2, 2], axis=1)
                seconds = time.perf_counter() - start
                yield Row(*head, float(np.median(focal)), float(np.median(principal)), seconds)


def table(name: str, rows: Sequence[Row]) -> str:
    """Markdown: the focal error in closed form and refined, the principal point's refined, and the time."""
    lines = [
        f"| {name} | way to K | focal, closed form | focal, refined | principal point, refined | s |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for closed, refined in zip(rows[::2], rows[1::2], strict=True):
        numbers = [f"{row.focal_pct:.3f} %" if not row.refusal else "refused" for row in (closed, refined)]
        principal = f"{refined.principal_px:.1f} px" if not refined.refusal else refined.refusal
        lines.append(
            f"| {closed.plane} | {closed.way} | {' | '.join(numbers)} | {principal} | {closed.seconds:.1f} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Reconstruct, calibrate, print a table a set."""
    sets = ["courtyard", *REAL_SCENES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", default=sets)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--cameras", choices=["shared", "per-image"], default="shared")
    arguments = parser.parse_args()
    for name in arguments.names:
        scene = load_fixture_scene(name) if name == "courtyard" else load_real_scene(name)
        assert scene is not None, f"{name} is not there; set THESISRECON_DATA"
        run = thesisrecon.reconstruct(scene.image_paths[0].parent, arguments.out / name, until="metric")
        assert run.projective is not None
        K = scene.K
        if K is None:
            assert run.metric is not None
            assert run.metric.reconstruction.K is not None
            K = run.metric.reconstruction.K
        rows = list(measure(run.projective, run.images, K, cameras=arguments.cameras))
        print(table(name, rows), end="\n\n", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
