"""``cameras.json`` read again."""

import json

import numpy as np
import pytest

from thesisrecon.errors import UsageError
from thesisrecon.io.exports import read_cameras

ONE = {
    "name": "a.jpg",
    "width": 160,
    "height": 120,
    "K": [[150.0, 0, 79.5], [0, 151.0, 59.5], [0, 0, 1]],
    "distortion": [-0.05, 0, 0],
    "R": np.eye(3).tolist(),
    "t": [0.1, 0.2, 3.0],
    "centre": [-0.1, -0.2, -3.0],
}


def written(folder, content):
    path = folder / "cameras.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_cameras_are_those_of_the_file_in_its_order(tmp_path):
    cameras = read_cameras(written(tmp_path, {"cameras": [{**ONE, "name": "b.jpg"}, ONE]}))
    assert list(cameras) == ["b.jpg", "a.jpg"]
    assert cameras["a.jpg"].size == (160, 120)
    np.testing.assert_array_equal(cameras["a.jpg"].K, ONE["K"])
    np.testing.assert_allclose(cameras["a.jpg"].centre, ONE["centre"])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"cameras": []}, "holds no camera"),
        ({"cameras": [{**ONE, "K": [[1.0, 0], [0, 1.0]]}]}, "does not hold cameras of this program"),
        ({"cameras": [{**ONE, "t": [None, 0, 0]}]}, "does not hold cameras"),
        ({"cameras": [{"name": "a.jpg"}]}, "does not hold cameras"),
        ({"cameras": {"0000.jpg": {}}}, "does not hold cameras"),
        ([], "does not hold cameras"),
        ("text", "does not hold cameras"),
    ],
)
def test_other_files_are_told_in_a_sentence(content, words, tmp_path):
    with pytest.raises(UsageError, match=words):
        read_cameras(written(tmp_path, content))


def test_an_absent_or_damaged_file_is_told(tmp_path):
    with pytest.raises(UsageError, match=r"there is no cameras\.json"):
        read_cameras(tmp_path / "cameras.json")
    (tmp_path / "cameras.json").write_text("{", encoding="utf-8")
    with pytest.raises(UsageError, match="does not hold cameras"):
        read_cameras(tmp_path / "cameras.json")
