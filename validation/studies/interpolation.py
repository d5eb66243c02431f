"""View interpolation beside the truth.

``fountain``: image 5 of fountain-P11 from 4 and 6. ``courtyard``: rendered along the baseline of two of its
views and off it, and within the triangle of three. ``time``: a frame of 1000 x 700 px.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.triangulation import triangulate
from thesisrecon.records import Image
from thesisrecon.view_interpolation import prepare_pair, prepare_rectified_pair
from thesisrecon.views.interpolation import InterpolatedPair
from validation.metrics.pictures import picture_metrics, psnr_db, ssim
from validation.metrics.record import Metric
from validation.metrics.timing import time_of_a_frame
from validation.scenes.between import (
    best_homography,
    camera_between,
    camera_centre_of,
    nearest_place,
    pose_of,
    square_camera,
    through,
    turned,
)
from validation.scenes.fixtures import SIZE, Pose, courtyard_poses
from validation.scenes.nine_views import dissolved, read_rgb
from validation.studies.runner import Part, Rows, load_scene
from validation.studies.tensor_views import (
    DIRECTIONS,
    VIEWS,
    CourtyardTruth,
    Measured,
    Place,
    courtyard,
    courtyard_image,
    courtyard_table,
    draw,
    save_beside,
)

OVER_SGBM_DB, OVER_DISSOLVE_DB = 0.3, 5.0
FRAME_SIZE, FRAME_S = (1000, 700), 1.0
PLACES = (
    *(Place(s) for s in (-0.5, -0.25, 0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0, 1.25, 1.5, 2.0)),
    *(Place(0.5, off, direction) for direction in ("up", "ahead") for off in (0.1, 0.25, 0.5, 1.0)),
)
"""Places of cameras in baselines; the images are at 0 and 1."""
DISTANCES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
THIRD = 5
"""View of the courtyard that spans a triangle with the other two."""
OURS, TRUE, DISSOLVE = "ours", "true disparity", "cross-dissolve"


def cameras_of(truth: CourtyardTruth) -> tuple[F64, F64]:
    """Return the cameras (3, 4) of both images."""
    one, two = (camera_from_centre(pose.K, pose.R, pose.C) for pose in truth.poses)
    return one, two


@dataclass(frozen=True)
class Yard:
    """The courtyard, its interpolated pair, common points X (N, 3) and their pixels."""

    truth: CourtyardTruth
    pair: InterpolatedPair
    X: F64
    xy1: F64
    xy2: F64


def prepare_yard() -> Yard:
    """Match the images of the courtyard; exact points come from its true correspondence."""
    truth = courtyard()
    images = [Image(f"{k}", rgb, SIZE) for k, rgb in zip(VIEWS, truth.images, strict=True)]
    y, x = np.indices(truth.places[0].shape[:2])[:, ::8, ::8].reshape(2, -1).astype(np.float64)
    xy1, xy2 = np.stack([x, y], axis=1), truth.places[0][::8, ::8].reshape(-1, 2).astype(np.float64)
    inside = np.all((xy2 > 0.0) & (xy2 < np.array(SIZE)), axis=1)
    xy1, xy2 = xy1[inside], xy2[inside]
    Xh = triangulate(np.stack(cameras_of(truth)), np.stack([xy1, xy2]), method="linear")
    return Yard(truth, prepare_pair(images[0], images[1]), Xh[:, :3] / Xh[:, 3:], xy1, xy2)


def camera_of(yard: Yard, place: Place) -> tuple[float, Pose]:
    """Return the nearest s between the images, and the true camera at ``place``, rotated as that view."""
    s = min(max(place.s, 0.0), 1.0)
    pose = pose_of(camera_between(yard.pair, cameras_of(yard.truth), s))
    step = yard.truth.poses[1].C - yard.truth.poses[0].C
    away = (place.s - s) * step
    if place.off:
        away = away + place.off * np.linalg.norm(step) * (pose.R.T @ np.array(DIRECTIONS[place.direction]))
    return s, Pose(pose.K, pose.R, pose.C + away)


def displaced(yard: Yard, place: Place) -> tuple[F64, F64 | None]:
    """Return displacements (N,) px of the view and the homography (3, 3) that rotates it.

    Between the images the view is compared as it is. Elsewhere the best homography maps it onto the true
    image, and parallax is left.
    """
    s, moved = camera_of(yard, place)
    there = project(camera_from_centre(moved.K, moved.R, moved.C), yard.X)
    here = yard.pair.frame.points(yard.xy1, yard.xy2, s)
    H = best_homography(here, there) if place.distance else None
    here = here if H is None else through(H, here)
    return np.linalg.norm(here - there, axis=1), H


def measure_place(yard: Yard, place: Place, out: Path) -> Measured:
    """Compare the nearest view between the images with the image from ``place``."""
    off, H = displaced(yard, place)
    s, moved = camera_of(yard, place)
    plain, square = square_camera(moved)
    turn = square if H is None else square @ H
    at_end = H is None and s in (0.0, 1.0)
    picture = yard.pair.view(s, turn=None if at_end else turn, threads=2)
    kept, wanted = within(np.eye(3) if at_end else turn), courtyard_image(yard.truth.world, plain)
    name = f"courtyard-{place.direction}-{place.off if place.off else place.s:+.2f}.jpg"
    save_beside(out / name, [wanted, picture])
    likeness = ssim(np.where(kept[..., None], picture, wanted), wanted)
    errors = float(np.median(off)), float(np.quantile(off, 0.9))
    return Measured(place, "interpolation", psnr_db(picture, wanted, where=kept), likeness, errors)


def within(turn: F64) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of a rotated view that lie in its own frame."""
    y, x = np.indices(SIZE[::-1], dtype=np.float64)
    back = through(np.asarray(np.linalg.inv(turn)), np.stack([x.ravel(), y.ravel()], axis=1))
    inside = ((back >= 0.0) & (back <= np.array(SIZE) - 1.0)).all(axis=1)
    return np.asarray(inside.reshape(SIZE[::-1]))


def linear_reach(yard: Yard, direction: str) -> tuple[float, float]:
    """Return the range and the slope of the median displacement over the distance from the baseline.

    The range (at most 3 baselines) ends where the displacement departs by 10 % from proportion; the slope is
    in px a baseline.
    """
    first, reach, slope = DISTANCES[0], 0.0, 0.0
    for distance in DISTANCES:
        place = Place(1.0 + distance) if direction == "along" else Place(0.5, distance, direction)
        off = float(np.median(displaced(yard, place)[0]))
        slope = off / distance if distance == first else slope
        if abs(off / distance - slope) > 0.1 * slope:
            break
        reach = distance
    return reach, slope


def measure_courtyard(out: Path) -> tuple[list[Measured], list[str], list[Metric]]:
    """Measure all places, the linear range and the triangle of three images."""
    yard, ranges = prepare_yard(), []
    for direction in ("along", *DIRECTIONS):
        reach, slope = linear_reach(yard, direction)
        where = "beyond the ends" if direction == "along" else f"off the middle, {direction}"
        text = f"{where}: displaced by {slope:.1f} px a baseline, in proportion up to {reach:g} baselines"
        ranges.append(text)
    return [measure_place(yard, place, out) for place in PLACES], ranges, [measure_triangle(yard, out)]


def measure_triangle(yard: Yard, out: Path) -> Metric:
    """Interpolate twice, to the middle of the triangle that a third image spans."""
    pose = courtyard_poses()[THIRD]
    third = Image(str(THIRD), courtyard_image(yard.truth.world, Pose(pose.K, pose.R, pose.C)), SIZE)
    middle = Image("middle", yard.pair.view(0.5), SIZE)
    P_third = camera_from_centre(pose.K, pose.R, pose.C)
    P_middle = camera_between(yard.pair, cameras_of(yard.truth), 0.5)
    second = prepare_pair(middle, third)
    values: dict[str, float | None] = {}
    for name, t in (("a third towards the third", 1.0 / 3.0), ("half way", 0.5)):
        P = camera_between(second, (P_middle, P_third), t)
        plain, turn = square_camera(pose_of(P))
        wanted, picture = courtyard_image(yard.truth.world, plain), second.view(t, turn=turn)
        values[name] = psnr_db(picture, wanted, where=within(turn))
        save_beside(out / f"courtyard-triangle-{t:.2f}.jpg", [wanted, picture])
    return Metric("courtyard, three images", "PSNR", "dB", values, "half way")


def measure_fountain(out: Path) -> list[Metric]:
    """Interpolate image 5 from 4 and 6, as it is and rotated onto it."""
    scene = load_scene("fountain-P11")
    if scene is None or scene.K is None or scene.R is None or scene.C is None:
        print("fountain-P11: not on this machine (THESISRECON_DATA), left out", flush=True)
        return []
    first, wanted, second = (Image(str(k), read_rgb(scene.image_paths[k]), (0, 0)) for k in (4, 5, 6))
    pair = prepare_pair(first, second)
    P4, P6 = (camera_from_centre(scene.K[k], scene.R[k], scene.C[k]) for k in (4, 6))
    s = nearest_place(pair, (P4, P6), scene.C[5])
    view, (width, height) = pair.view(s, threads=2), pair.size
    rays = scene.R[5].T @ np.linalg.inv(scene.K[5])
    seen = pose_of(camera_between(pair, (P4, P6), s))
    # The infinite homography: it relates the images of two cameras at one place.
    infinite = np.linalg.inv(seen.K @ seen.R @ rays)
    matches = pair_matches(view, wanted.rgb)
    best = best_homography(*matches)
    pictures = {
        "as it is": view,
        "turned as camera 5": pair.view(s, turn=infinite, threads=2),
        "turned best": pair.view(s, turn=best, threads=2),
    }
    pictures[DISSOLVE] = dissolved(first.rgb, second.rgb, s)
    ends = [
        turned(one.rgb, best_homography(*pair_matches(one.rgb, wanted.rgb)))[0] for one in (first, second)
    ]
    pictures["cross-dissolve, both turned best"] = dissolved(ends[0], ends[1], s)
    save_beside(out / "fountain-5.jpg", [wanted.rgb, pictures["turned best"], pictures[DISSOLVE]])
    save_whole(out / "fountain-5-view.png", [pictures["turned best"]])
    inner = np.zeros((height, width), dtype=bool)
    inner[height // 8 : -height // 8, width // 8 : -width // 8] = True
    metrics = picture_metrics("fountain-P11, 5 from 4 and 6", pictures, wanted.rgb)
    values: dict[str, float | None] = {n: psnr_db(p, wanted.rgb, where=inner) for n, p in pictures.items()}
    off = np.linalg.norm(camera_centre_of(pair, (P4, P6), s) - scene.C[5]) / np.linalg.norm(
        scene.C[6] - scene.C[4]
    )
    rows = Rows(metrics[0].scene, "turned best")
    rows.add("PSNR of the inner nine sixteenths", values, "dB")
    rows.add("camera 5 off the baseline", {"as it is": float(off)}, "baselines")
    rows.add("s", {"as it is": s})
    return [*metrics, *rows]


def pair_matches(first: U8, second: U8) -> tuple[F64, F64]:
    """Return verified matches of two images."""
    from thesisrecon import match_pair

    pair = match_pair(first, second)
    return pair.xy1, pair.xy2


def measure_time(repeats: int) -> Metric:
    """Time a frame of 1000 x 700 px between images of that size."""
    width, height = FRAME_SIZE
    rng = np.random.default_rng(0)
    y, x = np.indices((height, width))
    d = (20.0 + 8.0 * np.sin(x / 90.0) + 25.0 * ((x // 160 + y // 140) % 2)).astype(np.float32)
    left = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    right = np.take_along_axis(left, np.clip(x + np.rint(d).astype(int), 0, width - 1)[..., None], axis=1)
    pair = prepare_rectified_pair(left, right, disparity=d, config=PipelineConfig())
    draw_frame = partial(pair.view, 0.4, threads=2)
    return time_of_a_frame("1000 x 700", draw_frame, repeats=repeats, target_s=FRAME_S)


def save_whole(path: Path, pictures: list[U8]) -> None:
    """Save images in a row."""
    PIL.Image.fromarray(np.concatenate(pictures, axis=1)).save(path)


Name = Literal["fountain", "courtyard", "time"]


def interpolation_study(
    out: Path, parts: Sequence[Name] = ("fountain", "courtyard", "time"), repeats: int = 5
) -> Iterator[Part]:
    """Compare interpolated views with the truth; OUT gets the images and a plot."""
    if "fountain" in parts:
        yield measure_fountain(out)
    if "time" in parts:
        yield [measure_time(repeats)]
    if "courtyard" in parts:
        measured, ranges, more = measure_courtyard(out)
        yield courtyard_table(measured)
        yield "\n".join(ranges)
        yield more
        draw(measured).write_html(out / "interpolation.html", include_plotlyjs=True)
