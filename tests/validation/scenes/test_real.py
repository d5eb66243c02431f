"""Scenes are found by name, with their truth, and absent ones are said to be absent."""

import json

import numpy as np
import pytest

from validation.scenes.real import REAL_SCENES, load_fixture_scene, load_real_scene, read_scene

SIZES = {"fountain-P11": 11, "Herz-Jesus-P8": 8, "kermit": 11}


@pytest.mark.real
@pytest.mark.parametrize("name", REAL_SCENES)
def test_real_scenes(name):
    scene = load_real_scene(name)
    if scene is None:
        pytest.skip("the real photographs are not on this machine")
    assert len(scene.image_paths) == SIZES[name]
    assert [p.name for p in scene.image_paths] == sorted(p.name for p in scene.image_paths)
    assert scene.has_truth == (name != "kermit")
    if scene.has_truth:
        np.testing.assert_allclose(np.linalg.det(scene.R), 1.0, atol=1e-4)
        assert scene.K.shape == (SIZES[name], 3, 3)


def test_absent_photographs_are_none(monkeypatch, tmp_path):
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path))
    assert load_real_scene("kermit") is None
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path / "nowhere"))
    assert load_real_scene("kermit") is None


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="a real scene is one of"):
        load_real_scene("atlantis")
    with pytest.raises(ValueError, match="has none"):
        load_fixture_scene("atlantis")


def test_a_photograph_without_its_truth_is_named(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("a.jpg", "b.JPG", "notes.txt"):
        (tmp_path / "images" / name).touch()
    assert [p.name for p in read_scene(tmp_path, "x").image_paths] == ["a.jpg", "b.JPG"]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": {"a.jpg": {}}}))
    with pytest.raises(ValueError, match=r"b\.JPG"):
        read_scene(tmp_path, "x")
