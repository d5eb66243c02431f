"""A run that ended with a model: the painted sphere, seen from all round."""

from functools import cache

import numpy as np

from tests.surface.sphere import SHAPE, K, photograph, ring_of
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import HeldOut, MetricResult, Reconstruction, StageReport, Tracks
from thesisrecon.report.data import ReportData, ReportImage
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.mesh import coarser
from thesisrecon.surface.texture_atlas import TextureAtlas

SIZE = (SHAPE[1], SHAPE[0])
NAMES = tuple(f"sphere {k} <b>.jpg" for k in range(8))


@cache
def sphere_model():
    """The sphere in at most 6000 triangles with the texture of its photographs."""
    mesh = coarser(VolumetricFusion().fuse(ring_of()), 6_000)
    return TextureAtlas().texture(mesh, [photograph(m) for m in ring_of()])


@cache
def sphere_reconstruction():
    maps = ring_of()
    count = len(maps)
    X = np.random.default_rng(2).normal(size=(300, 3))
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    nothing = np.zeros(0, dtype=np.int64)
    return Reconstruction(
        stratum="metric",
        P=np.stack([m.P for m in maps]),
        X=homogenize(X),
        registered=np.ones(count, dtype=bool),
        valid=np.ones(len(X), dtype=bool),
        inlier=np.zeros(0, dtype=bool),
        tracks=Tracks(nothing, nothing, np.zeros((0, 2)), count, len(X)),
        sizes=np.tile(np.array(SIZE), (count, 1)),
        sigma_px=0.3,
        reasons=("",) * count,
        K=np.tile(K, (count, 1, 1)),
        distortion=np.zeros((count, 3)),
    )


def sphere_run():
    """The whole page of it: model, depth of all photographs but the last, the third held out."""
    maps = ring_of()
    rgb = [photograph(m).rgb for m in maps]
    seen = np.isfinite(maps[2].depth)
    shifted = np.roll(rgb[2], 1, axis=1)
    return ReportData(
        title="Sphere",
        photographs=tuple(
            ReportImage(name, SIZE, SIZE, pixels) for name, pixels in zip(NAMES, rgb, strict=True)
        ),
        reports=(StageReport("dense", 2.0), StageReport("model", 1.0)),
        config_text="",
        summary={},
        version="0.1.0",
        metric=MetricResult(sphere_reconstruction(), ({},) * len(maps), {}, trusted=True),
        model=sphere_model(),
        depth_pictures={m.view: m.depth for m in maps[:-1]},
        held_out=HeldOut(2, rgb[2], shifted, seen, psnr_db=27.3456, ssim=0.9123),
    )
