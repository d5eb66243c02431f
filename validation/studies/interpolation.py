"""Views by interpolation beside the truth: ``python -m validation.studies.interpolation [PART ...] [-o OUT]``.

``cones``: views 3, 4 and 5 of nine from 2 and 6, beside a cross-dissolve and the same warp with OpenCV's and
the true disparities. ``courtyard``: rendered anew along the baseline of two of its views and off it, and
within the triangle of three. ``fountain``: photograph 5 of fountain-P11 from 4 and 6. ``time``: a frame of
1000 x 700 px. OUT takes the pictures and the plot. The exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.io.files import write_text
from thesisrecon.records import Image
from thesisrecon.view_interpolation import rectified_pair, relate
from thesisrecon.views.interpolation import InterpolatedPair
from validation.studies.tensor_views import (
    DIRECTIONS,
    VIEWS,
    CourtyardTruth,
    Measured,
    Place,
    courtyard,
    courtyard_table,
    draw,
    photograph,
    save_beside,
)
from validation.metrics.pictures import picture_metrics, psnr_db, ssim
from validation.metrics.record import Metric, markdown_table
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
from validation.scenes.nine_views import (
    dissolved,
    read_rgb,
)
from validation.scenes.real import load_real_scene

OVER_SGBM_DB, OVER_DISSOLVE_DB = 0.3, 5.0
FRAME_SIZE, FRAME_S = (1000, 700), 1.0
PLACES = (
    *(Place(s) for s in (-0.5, -0.25, 0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0, 1.25, 1.5, 2.0)),
    *(Place(0.5, off, direction) for direction in ("up", "ahead") for off in (0.1, 0.25, 0.5, 1.0)),
)
"""Of cameras, in baselines; at 0 and 1 stand the photographs."""
DISTANCES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
THIRD = 5
"""View of the courtyard that spans the triangle with the other two."""
OURS, TRUE, DISSOLVE = "ours", "true disparity", "cross-dissolve"


def cameras_of(truth: CourtyardTruth) -> tuple[F64, F64]:
    """The cameras (3, 4) of both photographs."""
    one, two = (camera_from_centre(pose.K, pose.R, pose.C) for pose in truth.poses)
    return one, two


@dataclass(frozen=True)
class Yard:
    """The courtyard, its interpolated ``pair``, points ``X`` (N, 3) that both photographs see and their
    pixels ``xy1``, ``xy2``."""

    truth: CourtyardTruth
    pair: InterpolatedPair
    X: F64
    xy1: F64
    xy2: F64


def prepare_yard() -> Yard:
    """Match the courtyard's photographs; exact points from its true places."""
    truth = courtyard()
    images = [Image(f"{k}", rgb, SIZE) for k, rgb in zip(VIEWS, truth.photographs, strict=True)]
    y, x = np.indices(truth.places[0].shape[:2])[:, ::8, ::8].reshape(2, -1).astype(np.float64)
    xy1, xy2 = np.stack([x, y], axis=1), truth.places[0][::8, ::8].reshape(-1, 2).astype(np.float64)
    inside = np.all((xy2 > 0.0) & (xy2 < np.array(SIZE)), axis=1)
    xy1, xy2 = xy1[inside], xy2[inside]
    Xh = triangulate_linear(np.stack(cameras_of(truth)), np.stack([xy1, xy2]))
    return Yard(truth, relate(images[0], images[1]), Xh[:, :3] / Xh[:, 3:], xy1, xy2)


def camera_of(yard: Yard, place: Place) -> tuple[float, Pose]:
    """The nearest s between the photographs, and the true camera at ``place``: turned as that of the view."""
    s = min(max(place.s, 0.0), 1.0)
    pose = pose_of(camera_between(yard.pair, cameras_of(yard.truth), s))
    step = yard.truth.poses[1].C - yard.truth.poses[0].C
    away = (place.s - s) * step
    if place.off:
        away = away + place.off * np.linalg.norm(step) * (pose.R.T @ np.array(DIRECTIONS[place.direction]))
    return s, Pose(pose.K, pose.R, pose.C + away)


def displaced(yard: Yard, place: Place) -> tuple[F64, F64 | None]:
    """How far points of the view are from where ``place`` sees them (N,) px, and what it is turned by.

    Between the photographs it is compared as it is. Elsewhere, where interpolation cannot go, the view is
    turned onto the picture by the best homography (3, 3): what is left is parallax.
    """
    s, moved = camera_of(yard, place)
    there = project(camera_from_centre(moved.K, moved.R, moved.C), yard.X)
    here = yard.pair.frame.points(yard.xy1, yard.xy2, s)
    H = best_homography(here, there) if place.distance else None
    here = here if H is None else through(H, here)
    return np.linalg.norm(here - there, axis=1), H


def measure_place(yard: Yard, place: Place, out: Path | None) -> Measured:
    """The nearest view between the photographs beside the picture taken from ``place``."""
    off, H = displaced(yard, place)
    s, moved = camera_of(yard, place)
    plain, square = square_camera(moved)
    turn = square if H is None else square @ H
    at_end = H is None and s in (0.0, 1.0)
    picture = yard.pair.view(s, turn=None if at_end else turn, threads=2)
    kept, wanted = within(np.eye(3) if at_end else turn), photograph(yard.truth.world, plain)
    if out is not None:
        name = f"courtyard-{place.direction}-{place.off if place.off else place.s:+.2f}.jpg"
        save_beside(out / name, [wanted, picture])
    likeness = ssim(np.where(kept[..., None], picture, wanted), wanted)
    errors = float(np.median(off)), float(np.quantile(off, 0.9))
    return Measured(place, "interpolation", psnr_db(picture, wanted, where=kept), likeness, errors)


def within(turn: F64) -> NDArray[np.bool_]:
    """(H, W) pixels that a view turned so has of its own frame."""
    y, x = np.indices(SIZE[::-1], dtype=np.float64)
    back = through(np.asarray(np.linalg.inv(turn)), np.stack([x.ravel(), y.ravel()], axis=1))
    inside = ((back >= 0.0) & (back <= np.array(SIZE) - 1.0)).all(axis=1)
    return np.asarray(inside.reshape(SIZE[::-1]))


def linear_reach(yard: Yard, direction: str) -> tuple[float, float]:
    """Up to which distance from the baseline (in baselines, at most 3) the median displacement grows in
    proportion, within 10 %, and its slope, px a baseline."""
    first, reach, slope = DISTANCES[0], 0.0, 0.0
    for distance in DISTANCES:
        place = Place(1.0 + distance) if direction == "along" else Place(0.5, distance, direction)
        off = float(np.median(displaced(yard, place)[0]))
        slope = off / distance if distance == first else slope
        if abs(off / distance - slope) > 0.1 * slope:
            break
        reach = distance
    return reach, slope


def measure_courtyard(out: Path | None) -> tuple[list[Measured], list[str], list[Metric]]:
    """All places; what is told of the linear range; the triangle of three photographs."""
    yard = prepare_yard()
    told = []
    for direction in ("along", *DIRECTIONS):
        reach, slope = linear_reach(yard, direction)
        where = "beyond the ends" if direction == "along" else f"off the middle, {direction}"
        told.append(
            f"{where}: displaced by {slope:.1f} px a baseline, in proportion up to {reach:g} baselines"
        )
    print("\n".join(told), flush=True)
    rows = []
    for place in PLACES:
        rows.append(measure_place(yard, place, out))
        print(rows[-1], flush=True)
    return rows, told, [measure_triangle(yard, out)]


def measure_triangle(yard: Yard, out: Path | None) -> Metric:
    """The middle of the triangle that a third photograph spans, interpolated twice, and the two edges of
    it."""
    pose = courtyard_poses()[THIRD]
    third = Image(str(THIRD), photograph(yard.truth.world, Pose(pose.K, pose.R, pose.C)), SIZE)
    middle = Image("middle", yard.pair.view(0.5), SIZE)
    P_third = camera_from_centre(pose.K, pose.R, pose.C)
    P_middle = camera_between(yard.pair, cameras_of(yard.truth), 0.5)
    second = relate(middle, third)
    values: dict[str, float | None] = {}
    for name, t in (("a third towards the third", 1.0 / 3.0), ("half way", 0.5)):
        P = camera_between(second, (P_middle, P_third), t)
        plain, turn = square_camera(pose_of(P))
        wanted, picture = photograph(yard.truth.world, plain), second.view(t, turn=turn)
        values[name] = psnr_db(picture, wanted, where=within(turn))
        if out is not None:
            save_beside(out / f"courtyard-triangle-{t:.2f}.jpg", [wanted, picture])
    return Metric("courtyard, three photographs", "PSNR", "dB", values, "half way")


def measure_fountain(out: Path | None) -> list[Metric]:
    """Photograph 5 from 4 and 6: the view nearest to it, as it is and turned onto it."""
    scene = load_real_scene("fountain-P11")
    if scene is None or scene.K is None or scene.R is None or scene.C is None:
        print("fountain-P11: not on this machine (THESISRECON_DATA), left out", flush=True)
        return []
    first, wanted, second = (Image(str(k), read_rgb(scene.image_paths[k]), (0, 0)) for k in (4, 5, 6))
    pair = relate(first, second)
    P4, P6 = (camera_from_centre(scene.K[k], scene.R[k], scene.C[k]) for k in (4, 6))
    s = nearest_place(pair, (P4, P6), scene.C[5])
    view, (width, height) = pair.view(s, threads=2), pair.size
    rays = scene.R[5].T @ np.linalg.inv(scene.K[5])
    seen = pose_of(camera_between(pair, (P4, P6), s))
    # Of two cameras in one place every picture is the other's through this.
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
    if out is not None:
        save_beside(out / "fountain-5.jpg", [wanted.rgb, pictures["turned best"], pictures[DISSOLVE]])
        save_whole(out / "fountain-5-view.png", [pictures["turned best"]])
    inner = np.zeros((height, width), dtype=bool)
    inner[height // 8 : -height // 8, width // 8 : -width // 8] = True
    metrics = picture_metrics("fountain-P11, 5 from 4 and 6", pictures, wanted.rgb)
    values: dict[str, float | None] = {n: psnr_db(p, wanted.rgb, where=inner) for n, p in pictures.items()}
    off = np.linalg.norm(camera_centre_of(pair, (P4, P6), s) - scene.C[5]) / np.linalg.norm(
        scene.C[6] - scene.C[4]
    )
    return [
        *metrics,
        Metric(metrics[0].scene, "PSNR of the inner nine sixteenths", "dB", values, "turned best"),
        Metric(
            metrics[0].scene, "camera 5 off the baseline", "baselines", {"as it is": float(off)}, "as it is"
        ),
        Metric(metrics[0].scene, "s", "", {"as it is": s}, "as it is"),
    ]


def pair_matches(first: U8, second: U8) -> tuple[F64, F64]:
    """Verified matches of two pictures."""
    from thesisrecon import match_pair

    pair = match_pair(first, second)
    return pair.xy1, pair.xy2


def measure_time(repeats: int) -> Metric:
    """A frame of 1000 x 700 px between photographs as large, once the correspondence is known."""
    width, height = FRAME_SIZE
    rng = np.random.default_rng(0)
    y, x = np.indices((height, width))
    d = (20.0 + 8.0 * np.sin(x / 90.0) + 25.0 * ((x // 160 + y // 140) % 2)).astype(np.float32)
    left = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    right = np.take_along_axis(left, np.clip(x + np.rint(d).astype(int), 0, width - 1)[..., None], axis=1)
    pair = rectified_pair(left, right, disparity=d, config=PipelineConfig())
    draw_frame = partial(pair.view, 0.4, threads=2)
    return time_of_a_frame("1000 x 700", draw_frame, repeats=repeats, target_s=FRAME_S)


def save_whole(path: Path, pictures: list[U8]) -> None:
    """Pictures in a row."""
    PIL.Image.fromarray(np.concatenate(pictures, axis=1)).save(path)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write if asked, and say whether every target was reached."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.interpolation", description=__doc__)
    parser.add_argument("parts", nargs="*", default=["fountain", "courtyard", "time"])
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    wishes = parser.parse_args(arguments)
    if wishes.out is not None:
        wishes.out.mkdir(parents=True, exist_ok=True)
    rows: list[Metric] = []
    if "fountain" in wishes.parts:
        rows += measure_fountain(wishes.out)
    if "time" in wishes.parts:
        rows.append(measure_time(wishes.repeats))
    text = [table_of(scene, rows) for scene in dict.fromkeys(row.scene for row in rows)]
    if "courtyard" in wishes.parts:
        measured, told_of_range, more = measure_courtyard(wishes.out)
        rows += more
        text.append(f"### courtyard\n\n{courtyard_table(measured)}")
        text.append("\n".join(told_of_range))
        text += [table_of(scene, more) for scene in dict.fromkeys(row.scene for row in more)]
        if wishes.out is not None:
            draw(measured).write_html(wishes.out / "interpolation.html", include_plotlyjs=True)
    told = "\n\n".join(text)
    print(told)
    if wishes.out is not None:
        write_text(wishes.out / "interpolation.md", told + "\n")
    return int(any(row.verdict == "missed" for row in rows))


def table_of(scene: str, rows: list[Metric]) -> str:
    """The rows of one scene under its name."""
    return f"### {scene}\n\n{markdown_table([row for row in rows if row.scene == scene])}"


if __name__ == "__main__":
    sys.exit(main())
