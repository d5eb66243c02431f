"""Every public call with about forty kinds of input for each of its arguments.

The same numbers in another form give the same result. Anything else gives a result, or a sentence that
thesisrecon itself raises: never an error of numpy, numba or Python.
"""

import ast
import re
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import thesisrecon as tr
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.results import SparseModel, SparseView

PACKAGE = Path(tr.__file__).parent
rng = np.random.default_rng(0)
K = np.array([[400.0, 0, 79.5], [0, 400, 59.5], [0, 0, 1]])
R = Rotation.from_euler(
    "xyz", np.radians([[0, -9, 5], [8, -5, 0], [-5, 0, 9], [5, 5, 0], [-9, 8, 5], [5, 9, -5]])
)
R = R.as_matrix()
SIZE = (160, 120)
CAMERAS = [tr.Camera(K, r, np.array([0.0, 0, 12]), SIZE) for r in R]
P, T = np.array([camera.P for camera in CAMERAS]), np.tile([0.0, 0, 12], (6, 1))
X = rng.uniform(-1, 1, (40, 3))
XY = np.stack([camera.project(X) for camera in CAMERAS])
F = fundamental_from_cameras(P[0], P[1])
AROUND = K @ np.concatenate([R[:3], [[[0], [0], [5]], [[1], [0], [6]], [[0], [2], [4]]]], axis=2)
KRUPPA = np.stack([fundamental_from_cameras(AROUND[i], AROUND[j]) for i, j in ((0, 1), (0, 2), (1, 2))])
PROJECTIVE = P @ np.linalg.inv(rng.normal(size=(4, 4)))
GREY = np.rint(np.clip(128 + 60 * gaussian_filter(rng.normal(size=(120, 172)), 1.2) * 3, 0, 255)).astype(
    np.uint8
)
LEFT, RIGHT = np.ascontiguousarray(GREY[:, :160]), np.ascontiguousarray(GREY[:, 6:166])
CORNERS, FACES = (
    np.array([[-1.0, -1, 4], [1, -1, 4], [1, 1, 4], [-1, 1, 4]]),
    np.array([[0, 2, 1], [0, 3, 2]]),
)
FRONT = tr.Camera(K, np.eye(3), np.zeros(3), SIZE)
NAMED = {f"{i}.jpg": tr.Camera(K, r, -r @ c, SIZE) for i, (r, c) in enumerate(zip(R, X, strict=False))}
POSITIONS = {name: 2.0 * camera.centre for name, camera in NAMED.items()}
LISTED = {"view_index": np.tile(np.arange(6), 40), "point_index": np.repeat(np.arange(40), 6)}
LISTED["xy"] = XY[LISTED["view_index"], LISTED["point_index"]]
PAIR = [tr.Camera(K, R[3], np.array([x, 0.0, 0.0]), SIZE) for x in (0.0, 1.0)]
ROWS, SIZES = tuple((k, k) for k in range(40)), np.array([SIZE] * 6)
E = K.T @ F @ K
RING = np.column_stack([np.arange(6), (np.arange(6) + 1) % 6])
SQUARE = np.array([[[0, 0], [0, 1]], [[1, 0], [1, 1]], [[0, 0], [1, 0]], [[0, 1], [1, 1]]])
DIAGONALS = np.array([[[0, 0], [1, 1]], [[1, 0], [0, 1]]])
SEGMENTS = np.stack([XY[0, :9], XY[0, :9] + 0.2 * (np.array([900.0, 50]) - XY[0, :9])], axis=1)
BOARD = X[:, :2].copy()
BOARD_H = np.stack([camera.P[:, [0, 1, 3]] for camera in CAMERAS])
GROUPS, ANGLES = (
    CAMERAS[0].project(np.pad(a.reshape(-1, 2), ((0, 0), (0, 1)))).reshape(2, 2, 2, 2)
    for a in (SQUARE, np.stack([SQUARE[[0, 2]], DIAGONALS]))
)
BOARD_XY = np.stack([camera.project(X * [1, 1, 0]) for camera in CAMERAS])
SEARCH = {"confidence": 0.99, "max_samples": 100, "seed": 0}
RETURNED = {
    "RunResult", "FundamentalEstimate", "FundamentalFit", "TwoView", "BundleAdjustment", "Reconstruction",
    "SelfCalibration", "DisparityMap", "DepthMap", "ModelComparison", "StageFailure", "UsageError",
    "PipelineConfig", "Tracks", "TexturedMesh",
}  # fmt: skip
"""Public classes that calls return, or that hold the options or lists of another call of this table."""


class Tensor:
    """What torch.Tensor offers: ``__array__``, shape and dtype."""

    def __init__(self, array):
        self.array, self.shape, self.dtype = array, array.shape, array.dtype

    def __array__(self, dtype=None, copy=None):
        return self.array if dtype is None else self.array.astype(dtype)


class OnGraphicsCard(Tensor):
    """A tensor that cannot be converted."""

    def __array__(self, dtype=None, copy=None):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


def mesh(vertices=CORNERS, faces=FACES, colors=None):
    return tr.render(tr.TexturedMesh(vertices, faces, colors=colors), FRONT)


def corners(reconstruct, *args, **given):
    """The first stage alone: the corners that a run would use."""
    return [found.xy for found in reconstruct(*args, until="features", **given).features]


def model(centres):
    return SparseModel([SparseView(str(i), np.eye(3), -c) for i, c in enumerate(np.asarray(centres))])


CALLS = {
    "Camera": (tr.Camera, {"K": K, "R": R[0], "t": T[0], "size": SIZE, "distortion": np.array([0.1, 0.01])}),
    "Camera.from_matrix": (tr.Camera.from_matrix, {"P": P[0], "size": SIZE}),
    "Camera.project": (CAMERAS[0].project, {"X": X}),
    "Camera.unproject": (CAMERAS[0].unproject, {"xy": XY[0], "depth": X[:, 0] + 5.0}),
    "Camera.scaled": (CAMERAS[0].scaled, {"factor": 0.5}),
    "triangulate": (tr.triangulate, {"P": P, "xy": XY, "method": "linear"}),
    "resect": (tr.resect, {"X": X, "xy": XY[0], "K": K, "threshold_px": 1.0, "confidence": 0.99, "seed": 0}),
    "sample": (tr.sample, {"name": "cube"}),
    "decompose_camera": (tr.decompose_camera, {"P": P[0], "covariance": np.eye(12)}),
    "essential_from_fundamental": (
        tr.essential_from_fundamental,
        {"F": E, "K1": K, "K2": K, "covariance": np.eye(9)},
    ),
    "decompose_essential": (tr.decompose_essential, {"E": E, "xy1": XY[0], "xy2": XY[1], "K1": K, "K2": K}),
    "seven_point": (tr.seven_point, {"xy1": XY[0, :7], "xy2": XY[1, :7]}),
    "factorize_affine": (tr.factorize_affine, {"xy": XY, "orthographic": False}),
    "vanishing_points": (
        tr.vanishing_points,
        {"segments": SEGMENTS, "count": 1, "threshold_px": 3.0, "seed": 0},
    ),
    "rectify_plane": (
        tr.rectify_plane,
        {"parallel": GROUPS, "orthogonal": ANGLES},
    ),
    "single_view_heights": (
        tr.single_view_heights,
        {
            "vertical": np.array([10.0, -3000, 1]),
            "horizon": np.array([0.0, 1, -200]),
            "base": XY[0],
            "top": XY[0] - np.array([0, 30.0]),
            "reference": SEGMENTS[0],
            "height": 1.0,
            "sigma_px": 1.0,
        },
    ),
    "calibrate_from_homographies": (
        tr.calibrate_from_homographies,
        {"H": BOARD_H, "size": SIZE, "board": BOARD, "xy": BOARD_XY},
    ),
    "stitch": (tr.stitch, {"images": [LEFT, RIGHT]}),
    "cheirality": (tr.cheirality, {"P": P[0], "X": np.column_stack([X, np.ones(40)])}),
    "bundle_adjust": (
        lambda **given: tr.bundle_adjust(free=(), **given),
        {"cameras": CAMERAS, "X": X, "xy": XY},
    ),
    "bundle_adjust with options": (
        lambda **given: tr.bundle_adjust(CAMERAS[:3], X[:12], XY[:3, :12], **given),
        {
            "free": "focal",
            "prior": {"focal": 0.1},
            "loss": "huber",
            "loss_px": 1.0,
            "sigma_px": 0.5,
            "covariances": np.ones((3, 12)),
            "fixed_cameras": np.array([0]),
            "fixed_points": np.array([3]),
            "positions": np.array([camera.centre for camera in CAMERAS[:3]]),
            "position_std": 0.1,
            "control_points": X[:12],
            "control_std": np.full(3, 0.1),
            "shared": np.array([0, 0, 1]),
            "max_iterations": 3,
        },
    ),
    "bundle_adjust of a list": (
        lambda view_index, point_index, xy: tr.bundle_adjust(
            CAMERAS, X, tr.Tracks(view_index, point_index, xy, 6, 40), free=()
        ),
        LISTED,
    ),
    "reconstruct_from_matches": (
        lambda **given: corners(tr.reconstruct_from_matches, **given),
        {"keypoints": XY, "matches": {(0, 1): ROWS}, "sizes": SIZES, "names": list("abcdef"), "seed": 0},
    ),
    "reconstruct_from_matches with images": (
        lambda **given: corners(tr.reconstruct_from_matches, XY, {(0, 1): ROWS}, SIZES, **given),
        {"images": None, "masks": None, "out": None, "config": None, "threads": None},
    ),
    "reconstruct_from_matches by rows": (
        lambda rows: corners(tr.reconstruct_from_matches, XY, {(0, 1): rows}, SIZES),
        {"rows": ROWS},
    ),
    "reconstruct_from_matches by positions": (
        lambda xy1, xy2: corners(tr.reconstruct_from_matches, None, {(0, 1): (xy1, xy2)}, SIZES[:2]),
        {"xy1": XY[0], "xy2": XY[1]},
    ),
    "reconstruct_from_tracks": (
        lambda **given: corners(tr.reconstruct_from_tracks, **given),
        {"tracks": XY, "sizes": SIZES},
    ),
    "reconstruct_from_tracks of a list": (
        lambda **listed: corners(
            tr.reconstruct_from_tracks, tr.Tracks(**listed, n_views=6, n_points=40), SIZES
        ),
        LISTED,
    ),
    "reconstruct_from_colmap": (
        lambda **given: corners(tr.reconstruct_from_colmap, **given),
        {"path": None, "out": None},
    ),
    "reconstruction_from_cameras": (
        lambda K, R, t, **given: tr.reconstruction_from_cameras(K, R, t, **given),
        {"K": K, "R": R, "t": T, "sizes": SIZE, "X": X, "xy": XY},
    ),
    "plane_at_infinity": (
        tr.plane_at_infinity,
        {"reconstruction": P[:2], "sizes": SIZE, "vanishing_points": P[:2, :, :3].transpose(0, 2, 1)},
    ),
    "upgrade_affine": (
        tr.upgrade_affine,
        {
            "reconstruction": tr.reconstruction_from_cameras(P, sizes=SIZE, stratum="projective"),
            "plane": np.array([0.0, 0, 0, 1]),
        },
    ),
    "self_calibrate": (
        lambda **given: tr.self_calibrate(method="linear-quadric", **given),
        {"reconstruction": PROJECTIVE, "sizes": np.array(SIZE), "X": X, "xy": XY, "seed": 0},
    ),
    "average_rotations": (
        tr.average_rotations,
        {"pairs": RING, "R": R[RING[:, 1]] @ R[RING[:, 0]].swapaxes(1, 2), "weights": np.arange(1.0, 7.0)},
    ),
    "average_translations": (tr.average_translations, {"pairs": RING, "t": X[:6], "R": R}),
    "kruppa": (tr.kruppa, {"F": KRUPPA, "sizes": SIZE}),
    "estimate_fundamental": (
        tr.estimate_fundamental,
        {"xy1": XY[0], "xy2": XY[1], "method": "eight-point", "threshold_px": 1.0} | SEARCH,
    ),
    "estimate_homography": (
        tr.estimate_homography,
        {"xy1": XY[0], "xy2": 2.0 * XY[0], "threshold_px": 1.0} | SEARCH,
    ),
    "estimate_essential": (
        tr.estimate_essential,
        {"xy1": XY[0], "xy2": XY[1], "K1": K, "threshold_px": 1.0} | SEARCH,
    ),
    "recover_pose": (tr.recover_pose, {"E": K.T @ F @ K, "xy1": XY[0], "xy2": XY[1], "K1": K}),
    "decompose_homography": (
        tr.decompose_homography,
        {"H": K @ (R[0] + np.outer(T[0], [0.0, 0.0, 0.1])) @ np.linalg.inv(K), "K1": K, "xy1": XY[0]},
    ),
    "detect_corners": (
        tr.detect_corners,
        {"image": LEFT, "max_corners": 20, "threshold_rel": 0.01, "formula": "noble", "detector": None},
    ),
    "rectify_cameras": (tr.rectify_cameras, {"cameras": PAIR, "K": K, "size": SIZE}),
    "rectify_cameras of arrays": (
        lambda R, t, sizes: tr.rectify_cameras((K, R, t), sizes=sizes),
        {"R": R[[3, 3]], "t": np.array([[0.0, 0, 0], [1.0, 0, 0]]), "sizes": SIZE},
    ),
    "undistort_image": (
        lambda **given: tr.undistort_image(**{"image": LEFT, "camera": FRONT} | given),
        {"image": LEFT, "camera": FRONT, "K": K, "size": SIZE},
    ),
    "undistort_points": (lambda xy, K: tr.undistort_points(xy, CAMERAS[0], K), {"xy": XY[0], "K": K}),
    "estimate_trifocal": (
        tr.estimate_trifocal,
        {"xy1": XY[0, :9], "xy2": XY[1, :9], "xy3": XY[2, :9], "loss_px": 1.0, "threshold_px": None} | SEARCH,
    ),
    "epipolar_lines": (tr.epipolar_lines, {"F": F, "xy1": XY[0]}),
    "draw_epipolar_lines": (
        tr.draw_epipolar_lines,
        {"image1": LEFT, "image2": RIGHT, "F": F, "xy1": XY[0], "xy2": XY[1], "max_lines": 3},
    ),
    "rectify": (tr.rectify, {"image1": LEFT, "image2": RIGHT, "F": F, "xy1": XY[0], "xy2": XY[1]}),
    "match_rectified": (tr.match_rectified, {"left": LEFT, "right": RIGHT, "max_disparity_px": 8}),
    "interpolate_view": (
        tr.interpolate_view,
        {"left": LEFT, "right": RIGHT, "s": 0.5, "disparity": np.full((120, 160), 6.0, np.float32)},
    ),
    "depth_maps": (tr.depth_maps, {"images": None, "cameras": CAMERAS[:2], "depth_range": (5, 20)}),
    "fuse_depth_maps": (tr.fuse_depth_maps, {"depth_maps": None, "cameras": CAMERAS[:1]}),
    "texture": (tr.texture, {"mesh": None, "images": [LEFT], "cameras": CAMERAS[:1]}),
    "match_pair": (tr.match_pair, {"image1": None, "image2": RIGHT}),
    "synthesize_view": (
        tr.synthesize_view,
        {"image1": None, "image2": RIGHT, "rotation": np.eye(3), "translation": T[0], "K": K},
    ),
    "render": (mesh, {"vertices": CORNERS, "faces": FACES, "colors": np.full((4, 3), 90, np.uint8)}),
    "render with options": (
        lambda **given: tr.render(tr.TexturedMesh(CORNERS, FACES), **given),
        {"camera": FRONT, "background": (10, 20, 30), "samples": 1},
    ),
    "align_to_positions": (tr.align_to_positions, {"model": NAMED, "positions": POSITIONS, "seed": 0}),
    "scaled_by_points": (
        lambda ends, distance: tr.scaled_by_points(NAMED, dict.fromkeys(("0.jpg", "1.jpg"), ends), distance),
        {"ends": None, "distance": None},
    ),
    "scaled": (tr.scaled, {"model": NAMED, "name1": "0.jpg", "name2": "1.jpg", "distance": 2.0}),
    "compare_models": (
        tr.compare_models,
        {"a": NAMED, "b": NAMED, "max_time_difference": 0.1, "time_offset": 0.0},
    ),
    "export": (
        lambda **given: tr.export(**{"out": "exported"} | given),
        {"model": NAMED, "out": "exported", "to": "colmap", "overwrite": False},
    ),
    "export of images": (
        lambda **given: tr.export(NAMED, "exported", to="nerfstudio", **given),
        {"images": None, "masks": None, "threads": None},
    ),
    "write_mesh": (
        lambda **given: tr.write_mesh(**{"mesh": tr.TexturedMesh(CORNERS, FACES), "path": "a.glb"} | given),
        {"path": "a.glb", "mesh": tr.TexturedMesh(CORNERS, FACES)},
    ),
    "read_mesh": (tr.read_mesh, {"path": None}),
    "save": (tr.save, {"result": None, "folder": "saved"}),
    "Image": (tr.Image, {"name": "a.png", "rgb": LEFT, "original_size": SIZE, "mask": LEFT > 0}),
    "read_cameras": (tr.read_cameras, {"path": None}),
    "load": (tr.load, {"out": None}),
    "reconstruct with options": (
        lambda **given: corners(tr.reconstruct, [LEFT, RIGHT], **{"out": "run"} | given),
        dict.fromkeys(("out", "masks", "threads", "seed", "max_size", "preset", "cameras", "pairs")),
    ),
    "reconstruct": (lambda **given: tr.reconstruct(out="unused", **given), {"images": None}),
    "reconstruct_with_cameras": (
        lambda **given: tr.reconstruct_with_cameras("unused", out="unused", **given),
        {"cameras": None},
    ),
    "add_images": (lambda **given: tr.add_images(images="unused", **given), {"run": None}),
    "localize": (lambda **given: tr.localize(image="unused", **given), {"run": None}),
}
"""Calls with valid arguments; None: only wrong ones are tried, since a right one would take long."""


def holes(value, hole):
    """The numbers in double precision with one that is wrong."""
    array = np.array(value, dtype=np.float64)
    array.flat[array.size // 2] = hole
    return array


SAME = {
    "a list": lambda v: v.tolist(),
    "a tensor": Tensor,
    "read-only": lambda v: np.frombuffer(v.tobytes(), v.dtype).reshape(v.shape),
    "of Fortran": np.asfortranarray,
    "not contiguous": lambda v: np.repeat(v, 2, axis=-1)[..., ::2],
    "big-endian": lambda v: v.astype(v.dtype.newbyteorder(">")),
    "double precision": lambda v: v.astype(np.float64),
    "long double": lambda v: v.astype(np.longdouble),
    "of objects": lambda v: v.astype(object),
    "masked without a mask": np.ma.masked_array,
}
"""Other forms of an array of the same numbers."""
WRONG = {
    "None": None,
    "a word": "word",
    "bytes": b"word",
    "an object": object(),
    "a dictionary": {},
    "a set": {1, 2},
    "a function": len,
    "a generator": (i for i in range(3)),
    "a date": np.array(["2020-01-01"], dtype="datetime64[D]"),
    "true": True,
    "0": 0,
    "-1": -1,
    "1.5": 1.5,
    "NaN": float("nan"),
    "infinity": float("inf"),
    "an empty list": [],
    "an empty array": np.zeros((0, 2)),
    "lists of two lengths": [[1.0, 2.0], [3.0]],
    "a list of words": ["a", "b"],
    "a list of None": [None, None, None],
    "an array of no axes": np.array(3.0),
    "a tensor elsewhere": OnGraphicsCard(np.zeros(3)),
    "structured": np.zeros(3, dtype=[("x", float), ("y", float)]),
}
"""Things that are no such argument at all."""
REFUSED = {("reconstruct_from_tracks", "tracks"): {"a list"}}
"""Forms that a call refuses: a list may hold keypoints whose rows do not belong together."""
DAMAGED = {
    "complex": lambda v: np.asarray(v) + 1j,
    "of text": lambda v: np.asarray(v).astype(str),
    "all NaN": lambda v: np.full(np.shape(v), np.nan),
    "one NaN": lambda v: holes(v, np.nan),
    "one infinite": lambda v: holes(v, np.inf),
    "one huge": lambda v: holes(v, 1e300),
    "zeros": lambda v: np.zeros(np.shape(v)),
    "negative": lambda v: -np.asarray(v, dtype=np.float64),
    "tiny": lambda v: 1e-300 * np.asarray(v, dtype=np.float64),
    "one axis more": lambda v: np.asarray(v)[None],
    "one axis fewer": lambda v: np.asarray(v)[0],
    "flat": lambda v: np.ravel(v),
    "transposed": lambda v: np.asarray(v).T,
    "one row fewer": lambda v: np.asarray(v)[:-1],
    "one column fewer": lambda v: np.asarray(v)[..., :-1],
    "all masked": lambda v: np.ma.masked_all(np.shape(v)),
    "one masked": lambda v: np.ma.masked_array(holes(v, -1.0), np.isnan(holes(v, np.nan))),
}
"""Arrays of numbers that are no longer right."""


@cache
def raises_of(file):
    """Lines of the raise statements of a file."""
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    return {
        line
        for one in ast.walk(tree)
        if isinstance(one, ast.Raise)
        for line in range(one.lineno, one.end_lineno + 1)
    }


def outcome(call, arguments):
    """The result, or the sentence; an assertion if the error is not one of thesisrecon's own."""
    try:
        return call(**arguments), ""
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        own = isinstance(error, ValueError | tr.StageFailure)
        own &= Path(where.filename).is_relative_to(PACKAGE) and where.lineno in raises_of(where.filename)
        place = f"{Path(where.filename).name}:{where.lineno}"
        return None, str(error) if own else f"RAW {type(error).__name__} at {place}: {error}"


def arguments_of():
    return [(call, name) for call, (_, arguments) in CALLS.items() for name in arguments]


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_every_public_call_is_in_the_table():
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    public = {one.names[0].asname for one in stub.body if isinstance(one, ast.ImportFrom)}
    called = {re.split(r"[ .]", call)[0] for call in CALLS}
    assert public - RETURNED - called == set()
    assert public >= RETURNED


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("call", "name"), arguments_of())
def test_no_argument_gives_an_error_of_numpy(call, name):
    function, right = CALLS[call]
    value = right[name]
    kinds = dict(WRONG)
    if isinstance(value, np.ndarray | tuple):
        kinds |= {kind: make(value) for kind, make in DAMAGED.items()}
    said = {kind: outcome(function, right | {name: given})[1] for kind, given in kinds.items()}
    raw = [f"{kind}: {text}" for kind, text in said.items() if text.startswith("RAW")]
    assert not raw, "\n".join(raw)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("call", "name"), arguments_of())
def test_the_same_numbers_in_another_form_give_the_same_result(call, name):
    function, right = CALLS[call]
    value = right[name]
    if not isinstance(value, np.ndarray) or any(
        other is None for other in right.values() if other is not value
    ):
        pytest.skip("it is no array of numbers")
    expected = function(**right)
    for form in SAME.keys() - REFUSED.get((call, name), set()):
        make = SAME[form]
        found, said = outcome(function, right | {name: make(value)})
        assert not said, f"{form}: {said}"
        assert same(found, expected), form


def same(a, b):
    """Whether two results are equal within the rounding of another order of sums."""
    if isinstance(a, np.ndarray):
        return np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, Mapping):
        return list(a) == list(b) and all(same(value, b[name]) for name, value in a.items())
    if hasattr(a, "__dataclass_fields__"):
        return all(same(value, getattr(b, name)) for name, value in vars(a).items())
    return a == b or (a != a and b != b)


@pytest.mark.parametrize("missing", ["NaN", "masked"])
def test_missing_values_are_used_nowhere(missing):
    seen = np.ones((6, 40, 2), dtype=bool)
    seen[3:, ::3] = False
    pixels = np.where(seen, XY, np.nan)
    if missing == "masked":
        pixels = np.ma.masked_array(np.where(seen, XY, -1.0), ~seen)
    found = tr.triangulate(P, pixels)
    np.testing.assert_allclose(found[:, :3] / found[:, 3:], X, atol=1e-6)
    adjusted = tr.bundle_adjust(CAMERAS, X, pixels, free=())
    np.testing.assert_allclose(adjusted.X, X, atol=1e-6)
    tracks = tr.reconstruction_from_cameras(P, sizes=SIZE, xy=pixels).tracks
    assert len(tracks.xy) == seen[:, :, 0].sum()


FORMS = {
    "floats to 1": lambda a: (a / np.float32(255)).astype(np.float32),
    "floats to 255": lambda a: a.astype(np.float64),
    "floats to 65535": lambda a: a * 257.0,
    "16 bits": lambda a: a.astype(np.uint16) * 257,
    "12 bits": lambda a: np.rint(a * (4095 / 255)).astype(np.int32),
    "colours": lambda a: np.repeat(a[:, :, None], 3, axis=2),
    "one channel": lambda a: a[:, :, None],
    "alpha as floats": lambda a: np.dstack([np.repeat(a[:, :, None] / 255.0, 3, axis=2), np.ones(a.shape)]),
    "a list": lambda a: a.tolist(),
    "a tensor": Tensor,
    "of Pillow": PIL.Image.fromarray,
    "a record": lambda a: tr.Image("a.png", a, a.shape[::-1]),
}


@pytest.mark.parametrize("form", FORMS)
def test_images_of_all_kinds_are_the_same_image(form):
    make = FORMS[form]
    found = tr.match_rectified(make(LEFT), make(RIGHT), max_disparity_px=10).disparity
    known = np.isfinite(found)
    assert known.mean() > 0.6
    assert abs(np.median(found[known]) - 6.0) < 0.1
    drawn = tr.draw_epipolar_lines(make(LEFT), make(RIGHT), F, XY[0], XY[1], max_lines=0)
    for image, one in zip(drawn, (LEFT, RIGHT), strict=True):
        assert np.abs(image.astype(int) - one[:, :, None]).max() <= 1
    plane = tr.texture(tr.TexturedMesh(CORNERS / [8, 8, 1], FACES), [make(LEFT)], [FRONT]).texture
    assert 90 < np.median(plane) < 170


@pytest.mark.parametrize("scale", [1.0, 1 / 255, 257.0])
def test_a_dark_image_has_the_scale_of_its_pair(scale):
    bright, dark = 0.9 * LEFT * scale, 0.004 * LEFT * scale
    assert np.median(tr.draw_epipolar_lines(bright, dark, F, XY[0], XY[1], max_lines=0)[1]) <= 1


def test_levels_outside_all_ranges_are_refused():
    for levels in (LEFT / 127.5 - 1.0, LEFT - 200.0, LEFT * 1000.0, -LEFT.astype(int)):
        with pytest.raises(ValueError, match="levels of an image must be"):
            tr.match_rectified(levels, levels, max_disparity_px=4)
    with pytest.raises(ValueError, match="transpose it"):
        tr.match_rectified(np.stack([LEFT] * 3), np.stack([RIGHT] * 3), max_disparity_px=4)
