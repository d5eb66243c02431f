"""Views by the trilinear tensor beside the truth.

The courtyard is rendered at places along the baseline of two of its views and off it, with guessed and with
true intrinsics; image 5 of fountain-P11 is made from 4 and 6.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import PIL.Image

from thesisrecon.api.views import match_images
from thesisrecon.arrays import F32, F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import TwoView
from thesisrecon.views.trilinear import (
    CalibratedPair,
    VirtualCamera,
    camera_at,
    default_intrinsics,
    pair_from_fundamental,
    seed_of_two,
)
from thesisrecon.views.trilinear_synthesis import AGREE_PX, prepare_synthesis
from validation.metrics.pictures import picture_metrics, psnr_db, ssim
from validation.metrics.record import Metric
from validation.scenes.courtyard import build_courtyard
from validation.scenes.fixtures import SIZE, courtyard_poses, render_image
from validation.scenes.image_files import read_rgb
from validation.scenes.nine_views import dissolved
from validation.scenes.pose import Pose
from validation.scenes.raycast import World, trace
from validation.scenes.real import load_real_scene
from validation.studies.runner import Part, text_table

VIEWS = (6, 7)
"""Views of the courtyard: 11 degrees and 1.3 m apart, the scene 3 to 9 m away."""
DIRECTIONS = {"up": (0.0, -1.0, 0.0), "ahead": (0.0, 0.0, 1.0), "back": (0.0, 0.0, -1.0)}


@dataclass(frozen=True)
class Place:
    """A virtual camera: ``s`` baselines along the baseline, ``off`` baselines from it."""

    s: float
    off: float = 0.0
    direction: str = "along"

    def of(self, pair: CalibratedPair) -> VirtualCamera:
        camera = camera_at(pair, self.s, sizes=(SIZE, SIZE))
        if self.direction == "along":
            return camera
        step = self.off * np.array(DIRECTIONS[self.direction])
        return replace(camera, translation=camera.translation - step)


PLACES = (
    *(Place(s) for s in (-1.0, -0.5, -0.25, 0.25, 0.5, 0.75, 1.25, 1.5, 2.0)),
    *(Place(0.5, off, direction) for direction in DIRECTIONS for off in (0.1, 0.25, 0.5, 1.0)),
)


@dataclass(frozen=True)
class CourtyardTruth:
    """The world, two cameras, their images of equal exposure and the true places of the pixels."""

    world: World
    poses: tuple[Pose, Pose]
    images: tuple[U8, U8]
    places: tuple[F32, F32]

    def pair(self) -> CalibratedPair:
        """Return the true cameras in baselines."""
        one, two = self.poses
        t = two.R @ (one.C - two.C) / np.linalg.norm(two.C - one.C)
        return CalibratedPair(one.K, two.K, two.R @ one.R.T, t)

    def pose(self, camera: VirtualCamera) -> Pose:
        """Return the pose of a virtual camera in the world."""
        two = self.poses[1]
        step = camera.rotation.T @ camera.translation * np.linalg.norm(two.C - self.poses[0].C)
        return Pose(camera.K, camera.rotation @ two.R, two.C - two.R.T @ step)


def courtyard_image(world: World, pose: Pose) -> U8:
    """Render an image with the exposure of the pose and without white balance."""
    with PIL.Image.open(io.BytesIO(render_image(world, pose, 0)[0])) as image:
        return np.asarray(image.convert("RGB"))


@cache
def courtyard() -> CourtyardTruth:
    """Render the pair with the true correspondence from the traced depth."""
    world = build_courtyard()
    one, two = (replace(courtyard_poses()[k], exposure=1.0) for k in VIEWS)
    places = []
    for here, there in ((one, two), (two, one)):
        depth = trace(world, here, SIZE, shade=False)[1]
        y, x = np.indices(depth.shape)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(here.K).T
        X = rays * np.where(depth > 0.0, depth, np.nan)[..., None] @ here.R + here.C
        places.append(dehomogenize((X - there.C) @ (there.K @ there.R).T).astype(np.float32))
    pictures = courtyard_image(world, one), courtyard_image(world, two)
    return CourtyardTruth(world, (one, two), pictures, (places[0], places[1]))


@dataclass(frozen=True)
class Measured:
    """One rendered view: PSNR (dB), SSIM, median and 90 % quantile of the displacement (px)."""

    place: Place
    method: str
    psnr: float
    ssim: float
    off_px: tuple[float, float]


def measure_courtyard(out: Path) -> list[Measured]:
    """Render all places with true cameras, and with F and matches (true and guessed K)."""
    truth = courtyard()
    found = match_images(*truth.images, config=PipelineConfig())
    dense = found.dense.correspondences(0, SIZE), found.dense.correspondences(1, SIZE)
    pairs = {"all true": truth.pair(), **_pairs_of(found.pair, truth.poses[0].K, truth.poses[1].K, SIZE)}
    ready = {
        name: prepare_synthesis(
            pair,
            truth.images,
            truth.places if name == "all true" else dense,
            gain=found.dense.gain if name != "all true" else np.ones(3),
            agree_px=np.inf if name == "all true" else AGREE_PX,
        )
        for name, pair in pairs.items()
    }
    rows = []
    for place in PLACES:
        wanted = courtyard_image(truth.world, truth.pose(place.of(truth.pair())))
        shown = []
        for name, views in ready.items():
            picture = views.render(place.of(views.pair), threads=2)
            off = _displaced(truth, place, views.pair)
            rows.append(Measured(place, name, psnr_db(picture, wanted), ssim(picture, wanted), off))
            shown.append(picture)
        name = f"courtyard-{place.direction}-{place.off if place.off else place.s:+.2f}.jpg"
        save_beside(out / name, [wanted, *shown])
    return rows


def _pairs_of(pair: TwoView, K1: F64, K2: F64, size: tuple[int, int]) -> dict[str, CalibratedPair]:
    """Return the cameras of F with true and with guessed intrinsics."""
    guess = default_intrinsics(size)
    return {
        name: pair_from_fundamental(pair.F, pair.xy1, pair.xy2, K1=first, K2=second)
        for name, first, second in (("true K", K1, K2), ("guessed K", guess, guess))
    }


def _displaced(truth: CourtyardTruth, place: Place, pair: CalibratedPair) -> tuple[float, float]:
    """Return displacements (px) of the exact matches of view 1."""
    y, x = np.indices(truth.places[0].shape[:2])[:, ::8, ::8].reshape(2, -1).astype(np.float64)
    matches = truth.places[0][::8, ::8].reshape(-1, 2).astype(np.float64)
    both = []
    for cameras in (truth.pair(), pair):
        camera = place.of(cameras)
        tensor = seed_of_two(cameras).moved(camera.rotation, camera.translation, K=camera.K)
        both.append(tensor.transfer(np.stack([x, y], axis=1), matches)[0])
    inside = np.all((both[0] > 0.0) & (both[0] < np.array(SIZE)), axis=1)
    apart = np.linalg.norm(both[1] - both[0], axis=1)[inside]
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)), float(np.quantile(apart, 0.9))


def save_beside(path: Path, pictures: list[U8]) -> None:
    PIL.Image.fromarray(np.concatenate(pictures, axis=1)[::2, ::2]).save(path)


def courtyard_table(rows: list[Measured]) -> str:
    """Return PSNR, SSIM and median displacement by place and method."""
    lines = []
    for place in dict.fromkeys(row.place for row in rows):
        where = f"s = {place.s:g}" if place.direction == "along" else f"{place.off:g} {place.direction}"
        found = (r for r in rows if r.place == place)
        lines.append([where, *(f"{r.psnr:.1f} dB, {r.ssim:.3f}, {r.off_px[0]:.2f} px" for r in found)])
    return text_table(["place", *dict.fromkeys(row.method for row in rows)], lines)


def measure_fountain(out: Path) -> list[Metric]:
    """Render image 5 from 4 and 6 at its true place."""
    scene = load_real_scene("fountain-P11")
    if scene is None:
        return []
    (K1, K, K2), (R1, R, R2), (C1, C, C2) = (part[4:7] for part in scene.cameras)
    found = match_images(scene.image_paths[4], scene.image_paths[6])
    images = found.images
    size = images[0].size
    dense = found.dense.correspondences(0, size), found.dense.correspondences(1, size)
    wanted = read_rgb(scene.image_paths[5])
    baseline = float(np.linalg.norm(C1 - C2))
    pairs = {"true cameras": CalibratedPair(K1, K2, R2 @ R1.T, R2 @ (C1 - C2) / baseline)}
    pairs |= {f"F, {name}": pair for name, pair in _pairs_of(found.pair, K1, K2, size).items()}
    pictures: dict[str, U8] = {}
    for name, pair in pairs.items():
        views = prepare_synthesis(pair, (images[0].rgb, images[1].rgb), dense, gain=found.dense.gain)
        own = default_intrinsics(size) if "guessed" in name else K
        camera = VirtualCamera(R @ R2.T, R @ (C2 - C) / baseline, own, size)
        pictures[name] = views.render(camera, threads=2)
    pictures["cross-dissolve"] = dissolved(images[0].rgb, images[1].rgb, 0.5)
    save_beside(out / "fountain-5.jpg", [wanted, *pictures.values()])
    return picture_metrics("fountain-P11, 5 from 4 and 6", pictures, wanted)


def tensor_views_study(
    out: Path, parts: Sequence[Literal["fountain", "courtyard"]] = ("fountain", "courtyard")
) -> Iterator[Part]:
    """Compare views by the trilinear tensor with the truth; OUT gets the images."""
    if "fountain" in parts:
        yield measure_fountain(out)
    if "courtyard" in parts:
        yield courtyard_table(measure_courtyard(out))
