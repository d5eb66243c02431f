"""Readers with random bytes and damaged files: they read, or raise their documented errors."""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.bad_input.files import CAMERA, encoded, glb, require_sentence, triangle, writes
from tests.bad_input.files import SUMMARY as WHOLE
from tests.io.test_colmap import export, scene
from tests.io.test_meshes import roof
from tests.runtime.test_run_folder import some_metric
from thesisrecon.api.export import write_mesh
from thesisrecon.api.models import read_cameras
from thesisrecon.cli.commands import run_command
from thesisrecon.config import PipelineConfig
from thesisrecon.config.text import config_from_tables, config_from_toml, toml_from_config
from thesisrecon.errors import UsageError
from thesisrecon.io._files import read_json, read_pairs, read_text
from thesisrecon.io._images import read_images
from thesisrecon.io._meshes import read_mesh
from thesisrecon.io._models import read_model
from thesisrecon.runtime._run_folder import ChangedRecord, StageFolder, bytes_from_record, read_record

few = settings(
    derandomize=True,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
NUMBERS = (b"\xff" * 8, b"\0" * 8, np.array([np.nan]).tobytes(), np.array([1e308]).tobytes(), b"\x80" * 4)
WORDS = (b"nan", b"1e999", b"-1", b"9" * 400, b"null", b"[[", b'"', b"\n", b"\xff", b"{}")


@dataclass(frozen=True)
class Reader:
    """A file of this name that ``make`` writes, and how it is read."""

    name: str
    make: Callable[[Path], Any]
    read: Callable[[Path], Any]
    raises: tuple[type[Exception], ...] = ()


def saved(kind):
    """A photograph; one that is damaged is refused, and nothing is raised."""
    name, content = f"a.{kind.lower()}", writes(encoded(kind))
    return Reader(name, content, lambda path: read_images(path.parent, max_size_px=99))


CAMERAS = {"cameras": [CAMERA]}
REPORT = {"stage": "x", "seconds": 1.0, "counts": {"a": 1}, "metrics": {"b": 0.5}, "warnings": ["c"]}
MANIFEST = {"keys": {"a": "1"}, "report": REPORT}
SUMMARY = {
    **WHOLE, "refused": [{"name": "a", "reason": "b"}], "warnings": ["c"],
    "cameras": [{"camera": 0, "corners": 9, **{
        name: {"value": 1.0, "std": 0.1, "source": "data"}
        for name in ("focal_px", "principal_x_px", "principal_y_px", "aspect", "skew_px")
    }}],
}  # fmt: skip


def text_file(name, text, read):
    return Reader(name, writes(text), read, (UsageError,))


def inspected(path):
    assert run_command(["inspect", str(path.parent)]) in (0, 2)


def save_metric(path):
    path.write_bytes(bytes_from_record(some_metric(), "key"))


def as_written(path):
    record = read_record(path, "key")
    assert record is None or bytes_from_record(record, "key") == bytes_from_record(some_metric(), "key")


def part_of_model(name):
    return Reader(
        name, lambda path: export(path.parent, scene()), lambda p: read_model(p.parent), (UsageError,)
    )


READERS = [
    *(part_of_model(f"{name}.bin") for name in ("cameras", "images", "points3D")),
    text_file("poses.txt", "# time\n0 1 2 3 0 0 0.6 0.8\n1 1 2 4 0 0 0 1\n", read_model),
    *(saved(kind) for kind in ("JPEG", "PNG", "TIFF", "GIF", "WEBP", "BMP", "PPM")),
    text_file("cameras.json", json.dumps(CAMERAS), read_cameras),
    text_file("config.toml", toml_from_config(PipelineConfig()), lambda p: config_from_toml(read_text(p))),
    text_file("pairs.txt", '# list\na.png b.png\n"c d.png"\te.png\n', read_pairs),
    text_file("manifest.json", json.dumps(MANIFEST), lambda p: StageFolder(p.parent).finished({"a": "1"})),
    text_file("summary.json", json.dumps(SUMMARY), inspected),
    text_file("run.json", json.dumps(MANIFEST), read_json),
    Reader("a.npz", save_metric, as_written, (ChangedRecord,)),
    Reader("model.glb", lambda path: write_mesh(path, roof()), read_mesh, (UsageError,)),
    Reader("plain.glb", writes(glb(*triangle())), read_mesh, (UsageError,)),
]


@st.composite
def damaged(draw, whole):
    """The bytes with a few of them changed, cut off, inserted or repeated."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        # Most faults are in the header.
        at = draw(st.one_of(st.integers(0, min(len(data), 64)), st.integers(0, len(data))))
        what = draw(st.sampled_from(["one", "number", "word", "cut", "put", "twice"]))
        if what == "one" and at < len(data):
            data[at] = draw(st.integers(0, 255))
        elif what == "number":
            new = draw(st.sampled_from(NUMBERS))
            data[at : at + len(new)] = new
        elif what == "word":
            data[at : at + draw(st.integers(0, 8))] = draw(st.sampled_from(WORDS))
        elif what == "cut":
            del data[at : at + draw(st.integers(1, 400))]
        elif what == "put":
            data[at:at] = draw(st.binary(max_size=40))
        else:
            data[at:at] = data[at : at + draw(st.integers(1, 200))]
    return bytes(data)


def read(reader, path, content):
    path.write_bytes(content)
    with suppress(*reader.raises):
        reader.read(path)


@pytest.fixture
def place(request, tmp_path):
    """A reader, the file it reads and what that holds."""
    reader = request.param
    path = tmp_path / reader.name
    reader.make(path)
    whole = path.read_bytes()
    reader.read(path)
    return reader, path, whole


each_reader = pytest.mark.parametrize("place", READERS, indirect=True, ids=[r.name for r in READERS])


@each_reader
@few
@given(data=st.data())
def test_a_damaged_file_raises_only_documented_errors(place, data):
    reader, path, whole = place
    read(reader, path, data.draw(damaged(whole)))


@each_reader
@settings(few, max_examples=25)
@given(content=st.binary(max_size=300), head=st.sampled_from([0, 4, 8, 40]))
def test_random_bytes_raise_only_documented_errors(place, content, head):
    """As they are, and after the beginning of a good file."""
    reader, path, whole = place
    read(reader, path, whole[:head] + content)


plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just(10**400)
values = st.recursive(
    plain,
    lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=4), v, max_size=3),
    max_leaves=6,
)


@st.composite
def mistyped(draw, content):
    """The tables with one of their parts of another type, or gone."""
    if isinstance(content, dict) and content and draw(st.booleans()):
        key = draw(st.sampled_from(sorted(content)))
        rest = {k: v for k, v in content.items() if k != key}
        return rest if draw(st.integers(0, 4)) == 0 else content | {key: draw(mistyped(content[key]))}
    if isinstance(content, list) and content and draw(st.booleans()):
        at = draw(st.integers(0, len(content) - 1))
        return [*content[:at], draw(mistyped(content[at])), *content[at + 1 :]]
    return draw(values)


TABLES = [(reader, content) for reader in READERS for name, content in (
    ("cameras.json", CAMERAS), ("manifest.json", MANIFEST), ("summary.json", SUMMARY)
) if reader.name == name]  # fmt: skip


@pytest.mark.parametrize(("reader", "content"), TABLES, ids=[reader.name for reader, _ in TABLES])
@few
@given(data=st.data())
def test_tables_of_other_types_raise_only_documented_errors(reader, content, tmp_path, data):
    reported = json.dumps(data.draw(mistyped(content)))
    read(reader, tmp_path / reader.name, reported.encode("utf-8", "surrogatepass"))


@few
@given(data=st.data())
def test_settings_of_other_types_raise_only_documented_errors(data):
    whole = {"features": {"kind": "harris-corners"}, "intrinsics": {"focal_px": 9.0, "focal_std_rel": 0.1}}
    whole |= {"images": {"max_size_px": 640}}
    whole |= {"dense": {"pairs": {"matcher": {"kind": "maximum-likelihood-scanline"}}}}
    try:
        reported = data.draw(mistyped(whole).filter(lambda tables: isinstance(tables, dict)))
        toml_from_config(config_from_tables(reported))
    except UsageError as refusal:
        require_sentence(f"{refusal}\n")
