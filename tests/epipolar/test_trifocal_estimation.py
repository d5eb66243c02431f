"""The trifocal tensor of noisy points and lines: its steps, the refusals, and real photographs."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.epipolar.trifocal_estimation import (
    NO_POINTS,
    NO_SEGMENTS,
    _minimize_algebraic_error,
    estimate_trifocal,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import (
    calibration_matrix,
    camera_from_centre,
    decompose_camera,
    project,
)
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.three_view import (
    TensorEquations,
    cameras_from_tensor,
    tensor_equations,
    tensor_from_cameras,
    transfer_lines,
    transfer_points,
)

DATA = Path(os.environ.get("THESISRECON_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))


def three_cameras(rng):
    """Cameras 8 units from the origin, some 20 degrees apart."""
    K = calibration_matrix(1200.0, 1180.0, 640.0, 480.0, skew=3.0)
    cameras = []
    for turn in (-0.3, 0.1, 0.35):
        R = Rotation.from_rotvec([rng.normal(0.0, 0.1), turn, rng.normal(0.0, 0.1)]).as_matrix()
        cameras.append(camera_from_centre(K, R, rng.normal(0.0, 0.3, 3) - 8.0 * R[2]))
    return np.stack(cameras)


def matches(P, rng, n, m, sigma):
    X, A, B = (rng.uniform(-2.0, 2.0, (k, 3)) for k in (n, m, m))
    points = np.stack([project(camera, X) for camera in P])
    segments = np.stack([np.stack([project(camera, A), project(camera, B)], axis=1) for camera in P])
    return (
        points + rng.normal(0.0, sigma, points.shape) if sigma else points,
        segments + rng.normal(0.0, sigma, segments.shape) if sigma else segments,
    )


def point_transfer_px(T, points):
    return np.linalg.norm(transfer_points(T, points[0], points[1]) - points[2], axis=1)


def line_transfer_px(T, segments):
    """RMS distance of the third segment's ends to the transferred line; (M,)."""
    ends = homogenize(segments)
    l1, l2 = np.cross(ends[:2, :, 0], ends[:2, :, 1])
    found = unit_normals(transfer_lines(T, l1, l2))
    return np.sqrt(np.mean(np.einsum("na,nea->ne", found, ends[2]) ** 2, axis=1))


@pytest.mark.parametrize(("n", "m"), [(7, 0), (0, 13), (4, 5), (40, 0), (0, 40), (20, 20)])
def test_exact_matches_give_the_tensor_of_their_cameras(n, m):
    rng = np.random.default_rng(n + m)
    P = three_cameras(rng)
    found, T = estimate_trifocal(*matches(P, rng, n, m, 0.0)), tensor_from_cameras(*P)
    assert min(np.linalg.norm(found - T), np.linalg.norm(found + T)) < 1e-6


@dataclass(frozen=True)
class FickleEquations(TensorEquations):
    """Equations whose solution has the other sign each time, as a singular vector may have."""

    calls: list[int] = field(default_factory=list)

    def solve_with_epipoles(self, e2, e3):
        self.calls.append(1)
        return super().solve_with_epipoles(e2, e3) * (-1.0) ** len(self.calls)


def test_the_least_error_does_not_hang_on_the_signs_of_singular_vectors():
    rng = np.random.default_rng(3)
    equations = tensor_equations(*matches(three_cameras(rng), rng, 30, 0, 0.5))
    start = equations.solve()
    expected = _minimize_algebraic_error(equations, start)
    fickle = FickleEquations(equations.A, equations.noise, equations.transforms)
    found = _minimize_algebraic_error(fickle, start)
    assert len(fickle.calls) > 5
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.linalg.norm(equations.A @ expected.ravel()) < 1.0001 * np.linalg.norm(
        equations.A @ found.ravel()
    )


@pytest.mark.parametrize(("n", "m", "limit_px"), [(50, 0, 0.5), (0, 50, 0.8), (30, 30, 0.5)])
def test_the_epipoles_improve_the_linear_tensor_and_it_has_cameras(n, m, limit_px):
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        P = three_cameras(rng)
        points, segments = matches(P, rng, n, m, 0.5)
        exact, _ = matches(P, rng, 100, 0, 0.0)
        equations, T = tensor_equations(points, segments), estimate_trifocal(points, segments)
        of_cameras = tensor_from_cameras(*cameras_from_tensor(T))
        assert abs(np.sum(T * of_cameras)) / np.linalg.norm(of_cameras) == pytest.approx(1.0, abs=1e-9)
        tensors = equations.in_pixels(equations.solve()), T
        errors.append([np.median(point_transfer_px(tensor, exact)) for tensor in tensors])
    linear, constrained = np.median(errors, axis=0)
    assert constrained < min(limit_px, 0.5 * linear)


@pytest.mark.parametrize("sigma", [0.2, 1.0, 2.0])
@pytest.mark.parametrize("kind", ["plane", "rotation", "line", "chance"])
def test_noisy_matches_that_cannot_work_are_named(kind, sigma):
    refused = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (40, 3))
        if kind == "plane":
            X[:, 2] = 0.3 * X[:, 0]
        if kind == "line":
            X = np.outer(np.linspace(-2.0, 2.0, 40), [1.0, 0.3, 0.2])
        if kind == "rotation":
            P = np.stack(
                [camera_from_centre(*decompose_camera(p)[:2], np.array([0.0, 0.0, -8.0])) for p in P]
            )
        points = np.stack([project(camera, X) for camera in P])
        if kind == "chance":
            points = rng.uniform(0.0, 1000.0, points.shape)
        try:
            estimate_trifocal(points + rng.normal(0.0, sigma, points.shape))
        except StageFailure as failure:
            refused += "do not determine" in str(failure)
    # Noise hides one plane or rotation in thirty.
    assert refused >= (4 if kind in ("plane", "rotation") else 5)


def test_matches_that_cannot_work_are_named():
    rng = np.random.default_rng(0)
    points, segments = matches(three_cameras(rng), rng, 6, 0, 0.0)
    with pytest.raises(StageFailure, match="too few matches"):
        estimate_trifocal(points, segments)
    with pytest.raises(StageFailure, match="too few matches"):
        estimate_trifocal(NO_POINTS, NO_SEGMENTS)
    flat = np.column_stack([rng.uniform(-2.0, 2.0, (20, 2)), np.zeros(20)])
    line = np.outer(np.linspace(-1.0, 1.0, 20), [1.0, 0.5, 0.2])
    twice = np.tile(rng.uniform(-1.0, 1.0, (5, 3)), (4, 1))
    for special in (flat, line, twice):
        with pytest.raises(StageFailure, match="do not determine"):
            estimate_trifocal(np.stack([project(camera, special) for camera in three_cameras(rng)]))
    for wrong, text in (
        (np.ones((3, 8, 2)), "equal points"),
        (np.full((3, 8, 2), np.nan), "finite"),
        (np.ones((8, 2)), "needs points"),
        (np.ones(5), "needs points"),
    ):
        with pytest.raises(ValueError, match=text):
            estimate_trifocal(wrong)


def _read(kind):
    """Corners (3, N, 2) or segments (3, M, 4) that are matched in all three views of merton1."""
    folder = DATA / "merton1" / "2D"
    rows = [line.split() for line in (folder / f"nview-{kind}").read_text().splitlines()]
    index = np.array([[int(entry) for entry in row] for row in rows if "*" not in row])
    return np.stack([np.loadtxt(folder / f"{v + 1:03d}.{kind}")[index[:, v]] for v in range(3)])


@pytest.mark.real
@pytest.mark.skipif(not (DATA / "merton1").is_dir(), reason="the photographs of merton1 are not here")
@pytest.mark.parametrize("source", ["points", "lines", "both"])
def test_merton_college_is_transferred_into_the_third_view(source):
    points, segments = _read("corners"), _read("lines").reshape(3, -1, 2, 2)
    of_points, of_lines = [], []
    for fold in range(2):
        p, s = (np.arange(a.shape[1]) % 2 == fold for a in (points, segments))
        # Estimated from one half, measured on the other.
        T = estimate_trifocal(
            NO_POINTS if source == "lines" else points[:, p],
            NO_SEGMENTS if source == "points" else segments[:, s],
        )
        of_points.append(point_transfer_px(T, points[:, ~p]))
        of_lines.append(line_transfer_px(T, segments[:, ~s]))
    # Lines alone determine the tensor less well: most lie in a few planes.
    assert np.median(np.concatenate(of_points)) <= (1.3 if source == "lines" else 1.0)
    assert np.median(np.concatenate(of_lines)) <= 1.0
