"""The surface of the courtyard against its truth: ``python -m validation.checks.surface [-o OUT]``.

From photographs alone; cameras are laid over the true ones by a similarity. Surfaces of one reconstruction:
the thesis' variant of dense matching and ours, each fused by us, and of our depth maps also Open3D's grid of
truncated signed distances and its Poisson surface. Distances are Open3D's, in percent of the scene's depth
(the median over all true depth maps):

- accuracy: from points spread evenly over the surface to the true one. Counted is what at least two
  photographs could show: in their frames and not behind what they truly show by more than 5 % of depth.
- completeness: from the true point of every fourth pixel that another photograph shows too to the surface.

The exit code is 1 where the mean distance of our default is greater than that of Open3D's grid by a tenth.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.dense.matching import MaximumLikelihoodScanline
from thesisrecon.dense.multiview import MultiViewStereo, SequenceLinking
from thesisrecon.dense.multiview.correspondence import PairMatching
from thesisrecon.geometry.alignment import Similarity, estimate_similarity
from thesisrecon.model import SurfaceModel, surface_from_depth
from thesisrecon.model.mesh import face_areas
from thesisrecon.types import F64, I64, DepthMap, PinholeView, TexturedMesh
from validation.checks.dense_scene import depth_maps_of
from validation.checks.depth import true_depth
from validation.metrics.record import Metric, markdown_table
from validation.references.open3d_meshes import distances
from validation.references.open3d_surfaces import OpenTsdf, poisson_mesh
from validation.scenes.real import Scene, load_fixture_depth, load_fixture_scene

SAMPLES = 200_000
"""Points on a surface that distances are taken from."""

BEHIND = 0.05
"""How far behind what a photograph truly shows a point may be and still be asked for, in units of depth."""

CAPPED = 5.0
"""Percent of the scene's depth beyond which the mean counts no more."""

WITHIN = (0.2, 0.5, 1.0)

LEEWAY = 1.1
"""How much greater than Open3D's the mean distances of ours may be."""

OURS, TSDF = "default", "Open3D TSDF"
THESIS = MultiViewStereo(
    pairs=PairMatching(MaximumLikelihoodScanline()), linker=SequenceLinking(), refinement=None
)


@dataclass(frozen=True)
class Truth:
    """The true surface, the true points (N, 3) that two photographs show, and the scene's depth in metres."""

    scene: Scene
    surface: TexturedMesh
    points: F64
    depth_m: float


def load_truth() -> Truth:
    """The courtyard as its true depth maps have it, one sheet of triangles for each view."""
    scene = load_fixture_scene("courtyard")
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    sheets, points, depths = [], [], []
    for view in range(len(scene.image_paths)):
        depth, stride, seen = true_depth(scene, view)
        K = np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ scene.K[view]
        P = K @ scene.R[view] @ np.column_stack([np.eye(3), -scene.C[view]])
        std = np.zeros(depth.shape, dtype=np.float32)
        sheet = DepthMap(view, P, depth.astype(np.float32), std, np.ones(depth.shape, np.uint8))
        sheets.append(surface_from_depth(sheet, grazing_deg=1.0))
        y, x = np.nonzero(seen & (np.indices(depth.shape).sum(axis=0) % 2 == 0))
        rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(K).T
        points.append((rays * depth[y, x, None]) @ scene.R[view] + scene.C[view])
        depths.append(depth[np.isfinite(depth)])
    return Truth(scene, _together(sheets), np.concatenate(points), float(np.median(np.concatenate(depths))))


def _together(meshes: Sequence[TexturedMesh]) -> TexturedMesh:
    first = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    faces = [m.faces + n for m, n in zip(meshes, first, strict=True)]
    return TexturedMesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


def true_from_ours(maps: Mapping[int, DepthMap], scene: Scene) -> Similarity:
    """The similarity that lays the cameras of depth maps over the true ones."""
    assert scene.C is not None
    views = sorted(maps)
    centres = [-np.linalg.solve(maps[i].P[:, :3], maps[i].P[:, 3]) for i in views]
    return estimate_similarity(np.array(centres), scene.C[views])


def points_on(mesh: TexturedMesh, count: int = SAMPLES) -> F64:
    """(count, 3) points spread over a surface, as many on equal areas; the same ones each time."""
    rng = np.random.default_rng(0)
    area = np.cumsum(face_areas(mesh.vertices, mesh.faces))
    face = np.searchsorted(area, (np.arange(count) + rng.random(count)) * (area[-1] / count))
    s, t = rng.random((2, count, 1))
    turned = s + t > 1.0
    s, t = np.where(turned, 1.0 - s, s), np.where(turned, 1.0 - t, t)
    a, b, c = (mesh.vertices[mesh.faces[np.minimum(face, len(area) - 1), k]] for k in range(3))
    return np.asarray(a + s * (b - a) + t * (c - a))


def asked_for(points: F64, scene: Scene) -> I64:
    """(N,) in how many photographs points are in the frame and not hidden by what is truly there."""
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    count = np.zeros(len(points), dtype=np.int64)
    for view in range(len(scene.image_paths)):
        depth, stride = load_fixture_depth(view)
        q = (points - scene.C[view]) @ (scene.K[view] @ scene.R[view]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = q[:, :2] / q[:, 2:] / stride
            limit = np.array(depth.shape[::-1]) - 1
            inside = (q[:, 2] > 0.0) & ((at >= 0.0) & (at <= limit)).all(axis=1)
        x, y = np.rint(np.where(inside[:, None], at, 0.0)).astype(np.int64).T
        with np.errstate(invalid="ignore"):
            count += inside & (q[:, 2] <= (1.0 + BEHIND) * depth[y, x])
    return count


def judge(mesh: TexturedMesh, truth: Truth) -> tuple[F64, F64]:
    """Accuracy and completeness: distances in percent of the scene's depth."""
    points = points_on(mesh)
    points = points[asked_for(points, truth.scene) >= 2]
    unit = 100.0 / truth.depth_m
    chosen = truth.points[:: max(1, len(truth.points) // SAMPLES)]
    return unit * distances(points, truth.surface), unit * distances(chosen, mesh)


def surfaces(
    maps: Mapping[str, Mapping[int, DepthMap]], views: Mapping[int, PinholeView], *, threads: int = 1
) -> dict[str, TexturedMesh]:
    """The surfaces to be judged from depth maps of "default" and perhaps "thesis"."""
    found = {}
    for name, some in maps.items():
        found[name] = SurfaceModel().surface_of([some[i] for i in sorted(some)], threads=threads)
    ours = [maps[OURS][i] for i in sorted(maps[OURS])]
    found[TSDF] = OpenTsdf().fuse(ours, [views[m.view] for m in ours])
    found["Open3D Poisson"] = poisson_mesh(ours)
    return found


def table(judged: Mapping[str, tuple[F64, F64]]) -> list[Metric]:
    """All numbers of all surfaces; ours is held against Open3D's grid."""
    rows = []
    for side, what in enumerate(("accuracy", "completeness")):
        numbers: dict[str, tuple[str, dict[str, float], bool]] = {
            f"{what}, median": (
                "% of depth",
                {n: float(np.median(d[side])) for n, d in judged.items()},
                True,
            ),
            f"{what}, mean": (
                "% of depth",
                {n: float(np.minimum(d[side], CAPPED).mean()) for n, d in judged.items()},
                True,
            ),
        }
        for bound in WITHIN:
            shares = {n: 100.0 * float((d[side] <= bound).mean()) for n, d in judged.items()}
            numbers[f"{what}, within {bound} %"] = ("%", shares, False)
        for label, (unit, values, at_most) in numbers.items():
            target = LEEWAY * values[TSDF] if "mean" in label else None
            rows.append(Metric("courtyard", label, unit, values, OURS, target, at_most=at_most))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, say whether the targets are reached."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("-o", "--out", type=Path, help="where reconstructions are kept")
    parser.add_argument("--max-side", type=int, default=1024, help="px of the depth maps")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    truth = load_truth()
    with tempfile.TemporaryDirectory() as temporary:
        out = (options.out or Path(temporary)) / "courtyard"
        maps: dict[str, dict[int, DepthMap]] = {}
        views: dict[int, PinholeView] = {}
        for name, stereo in (("thesis", THESIS), (OURS, MultiViewStereo())):
            stereo = replace(stereo, max_side=options.max_side)
            maps[name], views = depth_maps_of(truth.scene.image_paths, out, stereo, threads=options.threads)
    align = true_from_ours(maps[OURS], truth.scene)
    judged = {}
    for name, mesh in surfaces(maps, views, threads=options.threads).items():
        judged[name] = judge(replace(mesh, vertices=align.apply(mesh.vertices)), truth)
        print(f"{name}: {len(mesh.faces)} faces", flush=True)
    rows = table(judged)
    print(f"\n## courtyard, {truth.depth_m:.2f} m deep\n\n{markdown_table(rows)}")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
