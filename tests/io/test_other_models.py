"""Models of other programs: what is written is read again; what other writers add; damaged files; meshes."""

import json

import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import Camera, UsageError, compare_models, detect_corners, read_cameras, read_mesh
from thesisrecon.io._models import read_model
from thesisrecon.results import SparseModel, SparseView

SIZE = (640, 480)


def _model():
    rng = np.random.default_rng(0)
    K = np.array([[500.0, 0, 310], [0, 500, 250], [0, 0, 1]])
    R = Rotation.from_rotvec(0.4 * rng.normal(size=(4, 3))).as_matrix()
    views = [SparseView(f"{i}.png", r, rng.normal(size=3), K, SIZE, np.zeros(3)) for i, r in enumerate(R)]
    return SparseModel(views, rng.normal(size=(9, 3)))


def test_nerf_gives_an_angle(tmp_path):
    (tmp_path / "train").mkdir()
    PIL.Image.new("L", (800, 600)).save(tmp_path / "train" / "r_0.png")
    pose = [[1.0, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    frames = [{"file_path": "./train/r_0", "transform_matrix": pose}]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    camera = read_cameras(path)["train/r_0"]
    assert camera.K[0, 0] == pytest.approx(400 / np.tan(0.4))
    assert camera.K[:2, 2].tolist() == [399.5, 299.5]
    np.testing.assert_allclose(camera.centre, [1, 2, 3])
    # Cameras of NeRF look along -z: here along +y of the world.
    np.testing.assert_allclose(camera.R[2], [0, 1, 0], atol=1e-12)


def test_kalibr_gives_a_chain(tmp_path):
    chain = tmp_path / "camchain.yaml"
    rows = "".join(f"  - [{', '.join(map(str, row))}]\n" for row in np.c_[np.eye(3), [-0.1, 0, 0]].tolist())
    entry = "  camera_model: pinhole\n  distortion_coeffs: [0.1, 0.2, {p}, 0.0]\n  distortion_model: radtan\n"
    entry += "  intrinsics: [400.0, 401.0, 320.0, 240.0]\n  resolution: [640, 480]\n"
    own = entry.format(p=0.0)
    chain.write_text(f"cam0:\n{own}cam1:\n  T_cn_cnm1:\n{rows}  - [0, 0, 0, 1]\n{own}")
    np.testing.assert_allclose(read_cameras(chain)["cam1"].centre, [0.1, 0, 0])
    chain.write_text(f"cam0:\n{entry.format(p=0.01)}")
    assert read_cameras(chain)["cam0"].distortion.tolist() == [0.1, 0.2, 0.01, 0.0, 0.0]
    chain.write_text(f"cam0:\n{entry.format(p=0.01)}".replace("radtan", "fov"))
    refuses(UsageError, "an unknown kind", read_cameras, chain)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("transforms.json", '{"frames": [{"file_path": "a"}]}', "must hold frames"),
        ("transforms.json", '{"frames": []}', "no camera"),
        ("camchain.yaml", "cam0:\n  resolution: [1]\n", "camchain.yaml of pinhole"),
    ],
)
def test_damaged_models_get_one_sentence(tmp_path, name, content, says):
    (tmp_path / name).write_text(content)
    refuses(UsageError, says, read_model, tmp_path / name)


def test_meshes_of_ply_and_obj_keep_axes_colours_and_texture(tmp_path):
    corners = "v 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
    (tmp_path / "a.obj").write_text(
        f"mtllib a.mtl\n{corners}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    PIL.Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "a.png")
    mesh = read_mesh(tmp_path / "a.obj")
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.texture.shape) == ((4, 3), (2, 3), (4, 4, 3))
    at = mesh.vertices[mesh.faces[0]], mesh.uv[0]
    np.testing.assert_allclose(
        at[1], np.column_stack([4 * at[0][:, 0], 4 - 4 * at[0][:, 1]]) - 0.5, atol=1e-6
    )
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {c}\n" for c in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 1 9 8 7\n1 0 1 9 8 7\n0 1 1 9 8 7\n3 0 1 2\n")
    mesh = read_mesh(tmp_path / "a.ply")
    assert mesh.vertices[1].tolist() == [1, 0, 1]
    assert mesh.colors.tolist() == [[9, 8, 7]] * 3
    refuses(UsageError, "GLB, PLY or OBJ", read_mesh, tmp_path / "a.mtl")
    refuses(UsageError, "there is no mesh", read_mesh, tmp_path / "b.ply")


def test_images_stand_for_their_sizes_and_corners_are_found():
    image = np.zeros((60, 80, 3), np.uint8)
    image[20:40, 30:60] = 200
    assert Camera(np.eye(3), np.eye(3), np.zeros(3), image).size == (80, 60)
    for formula in ("noble", "harris"):
        found = detect_corners(image, formula=formula, max_corners=4)
        # The edges lie between pixels; the smoothing moves the maximum to the inside.
        corners = np.array([[29.5, 19.5], [29.5, 39.5], [59.5, 19.5], [59.5, 39.5]])
        at = found.xy[np.lexsort(found.xy.round().T[::-1])]
        inward = np.sign([44.5, 29.5] - corners) * (at - corners)
        assert inward.shape == (4, 2)
        assert 0.0 < inward.min() <= inward.max() < 1.5
        np.testing.assert_allclose(inward, inward[0, 0], atol=1e-6)


def _numbers(*arrays):
    return " ".join(f"{v:.12g}" for a in arrays for v in np.ravel(a))


def test_cameras_of_data_sets_are_read_and_damaged_ones_refused(tmp_path):
    model = _model()
    lines = [f"{v.name} {_numbers(v.K, v.R, v.t)}" for v in model.views]
    (tmp_path / "dino_par.txt").write_text("\n".join([str(len(lines)), *lines]))
    found = [read_model(tmp_path / "dino_par.txt")]
    folders = [tmp_path / name for name in ("cams", "matrices", "pmvs")]
    for folder in folders:
        folder.mkdir()
    for view in model.views:
        stem, P = view.name.removesuffix(".png"), view.K @ np.c_[view.R, view.t]
        M = np.r_[np.c_[view.R, view.t], [[0, 0, 0, 1]]]
        text = f"extrinsic\n{_numbers(M)}\n\nintrinsic\n{_numbers(view.K)}\n\n425.0 2.5\n"
        (folders[0] / f"{stem}_cam.txt").write_text(text)
        (folders[1] / f"{stem}.P").write_text(_numbers(-3.0 * P))
        (folders[2] / f"{stem}.txt").write_text(f"CONTOUR\n{_numbers(P)}\n")
    found += [read_model(folder) for folder in folders]
    for other in found:
        assert [n.removesuffix(".png") for n in other.names] == ["0", "1", "2", "3"]
        for a, b in zip(other.views, model.views, strict=True):
            np.testing.assert_allclose(a.K, b.K, atol=1e-6)
            np.testing.assert_allclose(a.R, b.R, atol=1e-8)
            np.testing.assert_allclose(a.t, b.t, atol=1e-8)
    assert compare_models(folders[1], tmp_path / "dino_par.txt").centre_error.max() < 1e-8
    (tmp_path / "par.txt").write_text("2\na.png 1 2 3\n")
    refuses(UsageError, "2 cameras are announced, 1 follow", read_model, tmp_path / "par.txt")
    (tmp_path / "cams" / "0_cam.txt").write_text("extrinsic\n1 0 0 0\nintrinsic\n1 0 0\n")
    refuses(UsageError, "NAME_cam.txt with extrinsic and intrinsic", read_model, tmp_path / "cams")
    (tmp_path / "skew").mkdir()
    (tmp_path / "skew" / "0.P").write_text(_numbers([[500, 40, 300, 1], [0, 500, 200, 2], [0, 0, 1, 3]]))
    refuses(UsageError, "skewed pixels", read_model, tmp_path / "skew")
