"""Known questions to the reference libraries that check their conventions.

``python -m validation.references.canary LIBRARY`` ends with 3 and a message if an answer differs from the
adapters' expectation. A report runs them first, each in a process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from validation.references.libraries import NAMES, PACKAGES, NoReference, cv2, load, open3d, poselib, pycolmap

BLOB = 32
"""Row and column of the pixel in whose centre the image of :func:`_blob` has its blob."""


@dataclass(frozen=True)
class Question:
    """``ask`` computes the value named by ``words``; ``answer`` is the expected value up to ``tolerance``."""

    words: str
    ask: Callable[[], Any]
    answer: Any
    tolerance: float = 1e-6


def ask_canary(library: str) -> None:
    """Ask all questions to a library, by the name Python calls it.

    Raises :class:`NoReference` with the first answer that is not as expected, in a sentence.
    """
    load(library)
    for question in QUESTIONS[library]:
        who = f"{NAMES[library]} {_version(library)}"
        try:
            found = np.asarray(question.ask(), dtype=np.float64)
        except Exception as error:  # any exception means a changed library
            raise NoReference(
                f"{who} does not compute {question.words}, which this harness needs ({error})"
            ) from error
        expected = np.asarray(question.answer, dtype=np.float64)
        if found.shape != expected.shape or not np.allclose(
            found, expected, rtol=0.0, atol=question.tolerance
        ):
            raise NoReference(
                f"{who} gives {question.words} as {_short(found)}; this harness expects {_short(expected)}"
            )


def _version(library: str) -> str:
    try:
        return version(PACKAGES[library])
    except PackageNotFoundError:
        return "of an unknown version"


def _short(array: F64) -> str:
    return " ".join(np.array2string(array, precision=4, suppress_small=True, separator=" ").split())


def _matches() -> tuple[F64, F64]:
    """Twelve matches with y2 = 2 y1, and nothing else in common: x2' F x1 = 2 y1 - y2."""
    rng = np.random.default_rng(0)
    xy1 = rng.integers(-64, 64, (12, 2)).astype(np.float64)
    return xy1, np.column_stack([rng.integers(-64, 64, 12), 2.0 * xy1[:, 1]])


F_OF_MATCHES = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 2.0, 0.0))


def _scaled(F: Any) -> F64:
    """Scale so that the largest entry is 2, as in :data:`F_OF_MATCHES`."""
    F = np.asarray(F, dtype=np.float64)
    return np.asarray(2.0 * F / F.flat[np.argmax(np.abs(F))])


def _blob() -> Any:
    """An image (64, 64) of one round blob."""
    y, x = np.indices((2 * BLOB, 2 * BLOB))
    squared = (x - BLOB) ** 2 + (y - BLOB) ** 2
    return (255.0 * np.exp(-squared / 32.0)).astype(np.uint8)


def _opencv_blob() -> Any:
    return cv2.SIFT.create(enable_precise_upscale=True).detect(_blob(), None)[0].pt


def _opencv_projection() -> Any:
    K = np.array([[64.0, 0.0, 50.0], [0.0, 64.0, 40.0], [0.0, 0.0, 1.0]])
    X, none = np.array([[[1.0, 0.0, 2.0]]]), np.zeros(3)
    return cv2.projectPoints(X, none, none, K, np.array([0.25, 0.0, 0.0, 0.0]))[0].ravel()


def _opencv_quarter_turn() -> Any:
    return cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 2.0]))[0]


def _opencv_triangle() -> Any:
    P1, P2 = np.eye(3, 4), np.eye(3, 4)
    P2[0, 3] = -1.0
    found = cv2.triangulatePoints(P1, P2, np.zeros((2, 1)), np.array([[-0.5], [0.0]])).ravel()
    return found[:3] / found[3]


def _opencv_disparity() -> Any:
    left = np.random.default_rng(0).integers(0, 256, (48, 96)).astype(np.uint8)
    found = cv2.StereoSGBM.create(0, 16, 3).compute(left, np.roll(left, -4, axis=1))
    return np.median(found[10:38, 24:80])


def _colmap_blob() -> Any:
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found = extractor.extract_from_uint8_array(_blob())[0][0]
    return found.x, found.y


def _colmap_projection() -> Any:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=100, height=80, params=[64.0, 50.0, 40.0, 0.25])
    return np.ravel(camera.img_from_cam(np.array([[1.0, 0.0, 2.0]])))


def _colmap_pose() -> Any:
    turn = pycolmap.Rotation3d(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    return pycolmap.Rigid3d(turn, np.array([1.0, 2.0, 3.0])) * np.array([1.0, 0.0, 0.0])


def _colmap_triangle() -> Any:
    P1, P2 = np.eye(3, 4), np.eye(3, 4)
    P2[0, 3] = -1.0
    return pycolmap.triangulate_point(P1, P2, np.zeros(2), np.array([-0.5, 0.0]))


def _colmap_fundamental() -> Any:
    options = pycolmap.RANSACOptions(max_error=1.0, random_seed=0)
    found = pycolmap.estimate_fundamental_matrix(*_matches(), options)
    return None if found is None else _scaled(found["F"])


def _poselib_fundamental() -> Any:
    return _scaled(poselib.estimate_fundamental(*_matches(), {"max_epipolar_error": 1.0, "seed": 0}, {})[0])


def _open3d_depth() -> Any:
    """Return the point of a pixel (6, 2) off the principal point, depth 2, camera at (0, 0, -1)."""
    depth = np.zeros((4, 8), np.float32)
    depth[2, 6] = 2.0
    world = np.eye(4)
    world[2, 3] = 1.0
    pinhole = open3d.camera.PinholeCameraIntrinsic(8, 4, 4.0, 4.0, 2.0, 2.0)
    cloud = open3d.geometry.PointCloud.create_from_depth_image(
        open3d.geometry.Image(depth), pinhole, world, depth_scale=1.0, depth_trunc=1e9
    )
    return np.asarray(cloud.points)


def _open3d_motion() -> Any:
    points = np.random.default_rng(0).integers(0, 64, (40, 3)).astype(np.float64)
    moving, fixed = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (points, points + 0.25)
    )
    method = open3d.pipelines.registration.TransformationEstimationPointToPoint(False)
    found = open3d.pipelines.registration.registration_icp(moving, fixed, 1.0, np.eye(4), method)
    return np.asarray(found.transformation)[:3, 3]


def _open3d_distance() -> Any:
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]], np.float32)
    scene.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(np.array([[0, 1, 2]], np.uint32)))
    return scene.compute_distance(open3d.core.Tensor(np.array([[1, 1, 2]], np.float32)), nthreads=1).numpy()


QUESTIONS: dict[str, tuple[Question, ...]] = {
    "cv2": (
        Question(
            "F of matches with y2 = 2 y1",
            lambda: _scaled(cv2.findFundamentalMat(*_matches(), cv2.FM_8POINT)[0]),
            F_OF_MATCHES,
        ),
        Question("a blob in the middle of pixel (32, 32)", _opencv_blob, (BLOB, BLOB), 1e-3),
        Question("the image of (1, 0, 2) under k1 = 1/4", _opencv_projection, (84.0, 40.0)),
        Question(
            "the rotation vector (0, 0, pi/2)", _opencv_quarter_turn, ((0, -1, 0), (1, 0, 0), (0, 0, 1))
        ),
        Question("the point of two rays", _opencv_triangle, (0.0, 0.0, 2.0)),
        Question("a disparity of 4 px", _opencv_disparity, 64.0),
    ),
    "pycolmap": (
        Question(
            "the quaternion (0, 0, 1, 0)",
            lambda: pycolmap.Rotation3d(np.array([0.0, 0.0, 1.0, 0.0])).matrix(),
            np.diag([-1.0, -1.0, 1.0]),
        ),
        Question("(1, 0, 0) in the camera [R t]", _colmap_pose, (1.0, 3.0, 3.0)),
        Question("a blob in the middle of pixel (32, 32)", _colmap_blob, (BLOB + 0.5, BLOB + 0.5), 1e-3),
        Question("the image of (1, 0, 2) under k1 = 1/4", _colmap_projection, (84.0, 40.0)),
        Question("F of matches with y2 = 2 y1", _colmap_fundamental, F_OF_MATCHES),
        Question("the point of two rays", _colmap_triangle, (0.0, 0.0, 2.0)),
    ),
    "poselib": (Question("F of matches with y2 = 2 y1", _poselib_fundamental, F_OF_MATCHES),),
    "open3d": (
        Question("the point of a pixel of depth 2", _open3d_depth, ((2.0, 0.0, 1.0),)),
        Question("the motion onto points 1/4 farther", _open3d_motion, (0.25, 0.25, 0.25)),
        Question("the distance of a point from a triangle", _open3d_distance, (2.0,)),
    ),
}


def main(arguments: list[str] | None = None) -> int:
    (library,) = sys.argv[1:] if arguments is None else arguments
    try:
        ask_canary(library)
    except NoReference as error:
        print(error, file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
