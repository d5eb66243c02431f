"""Three views: the trifocal tensor on real images (merton1) and on synthetic scenes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar.trifocal_estimation import estimate_trifocal, refine_trifocal
from thesisrecon.epipolar.trifocal_ransac import TrifocalRansac
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre, project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.lines_and_planes import line_through, unit_normals
from thesisrecon.geometry.three_view import (
    estimate_tensor_linear,
    tensor_from_cameras,
    transfer_lines,
    transfer_points,
)
from validation.metrics.record import Metric
from validation.scenes.real import data_root
from validation.studies.runner import Part, Rows

NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))
WIDTH, HEIGHT = 1024, 768


def read_merton1(root: Path) -> tuple[F64, F64, F64]:
    """Read cameras (3, 3, 4), corners (3, N, 2) and segments (3, M, 2, 2) matched in all three views."""
    folder = root / "merton1" / "2D"

    def matched(kind: str) -> F64:
        rows = [line.split() for line in (folder / f"nview-{kind}").read_text().splitlines()]
        index = np.array([[int(entry) for entry in row] for row in rows if "*" not in row])
        return np.stack([np.loadtxt(folder / f"{v + 1:03d}.{kind}")[index[:, v]] for v in range(3)])

    cameras = np.stack([np.loadtxt(folder / f"{v + 1:03d}.P") for v in range(3)])
    return cameras, matched("corners"), matched("lines").reshape(3, -1, 2, 2)


def point_transfer_px(T: F64, points: F64) -> F64:
    """Return distances (N,) of the transferred points to those of view 3."""
    return np.asarray(np.linalg.norm(transfer_points(T, points[0], points[1]) - points[2], axis=1))


def line_transfer_px(T: F64, segments: F64) -> F64:
    """Return RMS distances (M,) of the segment ends in view 3 to the transferred lines."""
    ends = homogenize(segments)
    l1, l2 = line_through(ends[:2, :, 0], ends[:2, :, 1])
    found = unit_normals(transfer_lines(T, l1, l2))
    return np.asarray(np.sqrt(np.mean(np.einsum("na,nea->ne", found, ends[2]) ** 2, axis=1)))


def with_wrong(points: F64, segments: F64, share: float, rng: Generator) -> tuple[F64, F64, B8, B8]:
    """Replace a share of the points and exchange a share of the lines of view 3; also return which."""
    points, segments = points.copy(), segments.copy()
    n, m = points.shape[1], segments.shape[1]
    wrong, wrong_lines = np.zeros(n, dtype=bool), np.zeros(m, dtype=bool)
    wrong[rng.permutation(n)[: round(share * n)]] = True
    wrong_lines[rng.permutation(m)[: round(share * m)]] = True
    points[:, wrong] = rng.uniform((0.0, 0.0), (WIDTH, HEIGHT), (3, n, 2))[:, wrong]
    segments[2, wrong_lines] = np.roll(segments[2, wrong_lines], 1, axis=0)
    return points, segments, wrong, wrong_lines


Method = Callable[[F64, F64], F64]


def _robust(share: float) -> Method:
    def estimate(points: F64, segments: F64) -> F64:
        rng = np.random.default_rng(1)
        spoilt, spoilt_lines, _, _ = with_wrong(points, segments, share, rng)
        return TrifocalRansac().estimate(spoilt, spoilt_lines, rng=rng).fit.T

    return estimate


def check_merton1(root: Path) -> list[Metric]:
    """Measure the median transfer into view 3 of fits to all data and of fits to held-out halves."""
    cameras, points, segments = read_merton1(root)
    published = tensor_from_cameras(*cameras)
    methods: dict[str, tuple[Method, bool, bool]] = {
        "published cameras": (lambda _p, _s: published, True, True),
        "linear, points": (estimate_tensor_linear, True, False),
        "points": (lambda p, s: estimate_trifocal(p, s).T, True, False),
        "linear, lines": (estimate_tensor_linear, False, True),
        "lines": (lambda p, s: estimate_trifocal(p, s).T, False, True),
        "both": (lambda p, s: estimate_trifocal(p, s).T, True, True),
        "robust, points": (_robust(0.0), True, False),
        "robust, 30 % wrong": (_robust(0.3), True, False),
        "robust, 50 % wrong": (_robust(0.5), True, False),
        "robust, both, 30 % wrong": (_robust(0.3), True, True),
        "robust, both, 50 % wrong": (_robust(0.5), True, True),
    }
    rows = []
    for name, (method, with_points, with_lines) in methods.items():
        values: dict[str, float] = {}
        for held_out in (False, True):
            of_points, of_lines = [], []
            for fold in range(2 if held_out else 1):
                p, s = (np.arange(a.shape[1]) % 2 == fold for a in (points, segments))
                if not held_out:
                    p[:], s[:] = True, True
                T = method(
                    points[:, p] if with_points else NO_POINTS, segments[:, s] if with_lines else NO_SEGMENTS
                )
                seen_p, seen_s = (~p, ~s) if held_out else (p, s)
                of_points.append(point_transfer_px(T, points[:, seen_p]))
                of_lines.append(line_transfer_px(T, segments[:, seen_s]))
            tag = "held out" if held_out else "fit"
            values[f"points, {tag}"] = float(np.median(np.concatenate(of_points)))
            values[f"lines, {tag}"] = float(np.median(np.concatenate(of_lines)))
        # Linear fits and published cameras are reported without a bound.
        reported = name.startswith(("linear", "published"))
        kinds = ["points"] if with_points else ["lines"]
        if with_points and with_lines:
            kinds.append("lines")
        for kind in kinds:
            target = None if reported else 1.0
            row = f"{name}: median transfer of {kind}"
            rows.append(Metric("merton1", row, "px", _of(values, kind), "held out", target))
    return rows


def _of(values: dict[str, float], kind: str) -> dict[str, float]:
    return {tag: values[f"{kind}, {tag}"] for tag in ("fit", "held out")}


def make_three_views(rng: Generator, n: int) -> tuple[F64, F64]:
    """Draw cameras (3, 3, 4) 8 units from points, some 20 degrees apart, and pixels (3, n, 2)."""
    K = calibration_matrix(1200.0, 1180.0, 640.0, 480.0)
    cameras = []
    for turn in (-0.3, 0.1, 0.35):
        R = Rotation.from_rotvec([rng.normal(0.0, 0.1), turn, rng.normal(0.0, 0.1)]).as_matrix()
        cameras.append(camera_from_centre(K, R, rng.normal(0.0, 0.3, 3) - 8.0 * R[2]))
    X = rng.uniform(-2.0, 2.0, (n, 3))
    P = np.stack(cameras)
    return P, np.stack([project(camera, X) for camera in P])


def check_synthetic(sigma_px: float, n: int, share: float, trials: int) -> list[Metric]:
    """Measure the RMS transfer of exact points, relative to a refinement of the right tracks."""
    names = ["linear, right tracks", "least error, right tracks", "robust, all tracks"]
    squared: dict[str, list[float]] = {name: [] for name in names}
    seconds, precision, recall, failures = [], [], [], 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        P, exact = make_three_views(rng, n)
        noisy = exact + rng.normal(0.0, sigma_px, exact.shape)
        spoilt, _, wrong, _ = with_wrong(noisy, NO_SEGMENTS, share, rng)
        right = noisy[:, ~wrong]
        started = time.perf_counter()
        try:
            found = TrifocalRansac().estimate(spoilt, rng=rng)
        except StageFailure:
            failures += 1
            continue
        seconds.append(time.perf_counter() - started)
        reference = refine_trifocal(tensor_from_cameras(*P), right, NO_SEGMENTS, loss_px=3.0 * sigma_px)
        tensors = (estimate_tensor_linear(right, NO_SEGMENTS), reference.T, found.fit.T)
        for name, T in zip(names, tensors, strict=True):
            # Errors are capped at 100 px.
            squared[name].append(float(np.mean(np.minimum(point_transfer_px(T, exact), 100.0) ** 2)))
        precision.append(float(np.mean(~wrong[found.inliers])))
        recall.append(float(np.mean(found.inliers[~wrong])))
    rows = Rows(f"sigma {sigma_px:g} px, {n} tracks, {100 * share:g} % wrong, {trials} trials", names[2])
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in squared.items()}
    ratio = {name: rms[name] / rms[names[1]] for name in names}
    rows.add("RMS transfer of exact points", rms, "px")
    rows.add("relative to the least error of the right tracks", ratio, at_most=1.1)
    rows.add("precision", float(np.mean(precision)), at_least=0.99)
    rows.add("recall", float(np.mean(recall)), at_least=0.95)
    rows.add("failures", failures, at_most=0.0)
    rows.add("median time", float(np.median(seconds)), "s")
    return rows


def trifocal_study(
    trials: int = 100,
    tracks: Sequence[int] = (60, 200),
    noise: Sequence[float] = (0.5, 1.0, 2.0),
    wrong: Sequence[float] = (0.3, 0.5),
) -> Iterator[Part]:
    """Measure the trifocal tensor on the Merton College images and on synthetic scenes.

    Parameters
    ----------
    tracks : sequence of int
        Numbers of point tracks.
    """
    root = data_root()
    if root is not None and (root / "merton1").is_dir():
        yield check_merton1(root)
    for sigma in noise:
        for n in tracks:
            for share in wrong:
                yield check_synthetic(sigma, n, share, trials)
