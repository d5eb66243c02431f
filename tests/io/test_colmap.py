from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.io._colmap import write_colmap_model
from thesisrecon.records import Reconstruction, Tracks

V, N = 5, 40
NAMES = ["a b.jpg", "böld.jpg", "c.jpg", "d.jpg", "e.jpg"]
SIZE = (512, 384)


def scene(*, k=(0.0, 0.0, 0.0), aspect=1.0, noise_px=0.3):
    """Five views of forty points; view 3 is not registered, every ninth point not valid, some outliers."""
    rng = np.random.default_rng(5)
    X = np.column_stack([rng.uniform(-1, 1, (N, 3)), np.ones(N)])
    K = np.broadcast_to([[600.0, 0, 250.3], [0, 600.0 * aspect, 195.1], [0, 0, 1]], (V, 3, 3)).copy()
    R = Rotation.from_rotvec(rng.normal(0, 0.4, (V, 3))).as_matrix()
    t = np.column_stack([rng.normal(0, 0.3, (V, 2)), rng.uniform(4, 6, V)])
    registered = np.arange(V) != 3
    valid = np.arange(N) % 9 != 4
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(V), np.arange(N)))
    xy = np.array(
        [
            project_camera(K[i], R[i], t[i], X[j : j + 1, :3], distortion=np.array(k))[0]
            for i, j in zip(view, point, strict=True)
        ]
    )
    X[~valid] = 0
    return Reconstruction(
        stratum="metric", P=np.where(registered[:, None, None], compose_camera(K, R, t), 0.0), X=X,
        registered=registered, valid=valid, inlier=rng.random(V * N) > 0.15,
        tracks=Tracks(view, point, xy + rng.normal(0, noise_px, xy.shape), V, N),
        sizes=np.tile(SIZE, (V, 1)), sigma_px=noise_px,
        reasons=tuple("" if known else "too few points" for known in registered),
        K=np.where(registered[:, None, None], K, 0.0), distortion=np.tile(k, (V, 1)),
    )  # fmt: skip


def export(folder, reconstruction, *, scale=1.0, names=NAMES):
    return write_colmap_model(
        folder, reconstruction, names,
        colors=np.random.default_rng(0).integers(0, 256, (N, 3), dtype=np.uint8),
        groups=np.zeros(V, dtype=np.int64), scales=np.full(V, scale),
        original_sizes=np.tile((1537, 1155), (V, 1)),
    )  # fmt: skip


@pytest.mark.references
@pytest.mark.parametrize(
    ("k", "aspect", "kind"),
    [
        ((0.0, 0.0, 0.0), 1.0, "SIMPLE_PINHOLE"),
        ((0.0, 0.0, 0.0), 1.01, "PINHOLE"),
        ((-0.12, 0.0, 0.0), 1.0, "SIMPLE_RADIAL"),
        ((-0.12, 0.0, 0.0), 1.01, "OPENCV"),
        ((-0.1, 0.05, -0.02), 1.0, "FULL_OPENCV"),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_pycolmap_projects_as_we_do(tmp_path, k, aspect, kind, scale):
    import pycolmap

    ours = scene(k=k, aspect=aspect)
    assert export(tmp_path, ours, scale=scale) == 0
    theirs = pycolmap.Reconstruction(tmp_path)

    assert theirs.num_reg_images() == 4
    assert {camera.model.name for camera in theirs.cameras.values()} == {kind}
    compared = 0
    for i in np.flatnonzero(ours.registered):
        image = theirs.images[int(i) + 1]
        assert image.name == NAMES[i]
        camera = theirs.cameras[image.camera_id]
        assert (camera.width, camera.height) == (1537, 1155)
        pose = np.linalg.solve(ours.K[i], ours.P[i])
        for seen in image.points2D:
            j = seen.point3D_id - 1
            X = ours.X[j : j + 1, :3]
            xy = project_camera(ours.K[i], pose[:, :3], pose[:, 3], X, distortion=ours.distortion[i])[0]
            projected = image.project_point(theirs.points3D[j + 1].xyz)
            np.testing.assert_allclose(projected, (xy + 0.5) * scale, atol=1e-6, rtol=0)
            at = int(j * V + i)
            np.testing.assert_allclose(seen.xy, (ours.tracks.xy[at] + 0.5) * scale, atol=1e-9, rtol=0)
            assert ours.inlier[at]
            compared += 1
    assert compared > 100
    stored = theirs.compute_mean_reprojection_error()
    theirs.update_point_3d_errors()
    assert theirs.compute_mean_reprojection_error() == pytest.approx(stored, abs=1e-9)


@pytest.mark.references
def test_views_of_a_group_share_a_camera_only_where_their_intrinsics_agree(tmp_path):
    import pycolmap

    ours = scene()
    K, P = ours.K.copy(), ours.P.copy()
    K[1, 0, 0] = K[1, 1, 1] = 650.0
    P[1] = K[1] @ np.linalg.solve(ours.K[1], ours.P[1])
    export(tmp_path, replace(ours, K=K, P=P))
    images = pycolmap.Reconstruction(tmp_path).images
    assert [images[i].camera_id for i in (1, 2, 3, 5)] == [1, 2, 1, 1]
    export(tmp_path / "bare", replace(ours, valid=np.zeros(N, bool)))
    theirs = pycolmap.Reconstruction(tmp_path / "bare")
    assert (theirs.num_reg_images(), theirs.num_points3D()) == (4, 0)


def test_a_model_with_skew_is_not_written(tmp_path):
    ours = scene()
    K = ours.K.copy()
    K[:2, 0, 1] = 2.0
    assert export(tmp_path, replace(ours, K=K)) == 2
    assert not list(tmp_path.iterdir())
