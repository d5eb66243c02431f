"""The run folder, its record files, a disk that is full, and the position of an unfinished run."""

import errno
import json
import shutil
import zipfile

import numpy as np
import pytest

from tests.conftest import refuses
from tests.pipeline.fake_stages import fake_config, interrupt_at, photographs
from thesisrecon import records
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.cli.commands import run_command
from thesisrecon.errors import OutputError, UsageError
from thesisrecon.io._files import read_json, write_atomically, write_json
from thesisrecon.pipeline import algorithm1
from thesisrecon.pipeline.run import run_position
from thesisrecon.runtime._run_folder import (
    ChangedRecord,
    RunDirectory,
    StageFolder,
    bytes_from_record,
    key_of,
    read_record,
    sealed,
)
from validation.studies.robustness import SmallRuns, different, disk_ends, outputs, refused_at


def some_features(value=1.0):
    seeds = records.Seeds(
        np.full((2, 2), value), np.ones(2, np.float32), np.zeros(2, np.float32), np.eye(2, dtype=np.float32)
    )
    return records.Features(
        np.arange(6.0).reshape(3, 2), np.ones(3, np.float32), np.zeros(3, np.float32), seeds
    )


def some_metric():
    tracks = records.Tracks(np.zeros(1, np.int64), np.zeros(1, np.int64), np.ones((1, 2)), 2, 1)
    reconstruction = records.Reconstruction(
        stratum="metric", P=np.ones((2, 3, 4)), X=np.ones((1, 4)), registered=np.array([True, False]),
        valid=np.array([True]), inlier=np.array([True]), tracks=tracks, sizes=np.array([[4, 3], [4, 3]]),
        sigma_px=0.5, reasons=("", "ünsüitable"),
    )  # fmt: skip
    intervals = ({"focal_px": records.IntrinsicInterval(100.0, 1.0, "data")}, {})
    return records.MetricResult(reconstruction, intervals, {"checked": 1.0}, False, ("a doubt",))


def test_records_survive_the_disk_under_their_key_and_damage_is_reported(tmp_path):
    folder = StageFolder(tmp_path / "01")
    folder.save("a", "key", some_features())
    folder.save("b", "key", some_metric())
    features, metric = folder.load("a", "key"), folder.load("b", "key")
    np.testing.assert_array_equal(features.seeds.patches, np.eye(2, dtype=np.float32))
    assert features.seeds.patches.dtype == np.float32
    assert metric.reconstruction.reasons == ("", "ünsüitable")
    assert metric.reconstruction.K is None
    assert metric.intrinsics[0]["focal_px"] == records.IntrinsicInterval(100.0, 1.0, "data")
    assert metric.failed_checks == ("a doubt",)
    assert metric.reconstruction.registered.dtype == np.bool_
    assert bytes_from_record(some_metric(), "k") == bytes_from_record(some_metric(), "k")
    assert bytes_from_record(some_features(1.0), "k") != bytes_from_record(some_features(2.0), "k")
    folder = StageFolder(tmp_path)
    assert folder.load("a", "key") is None
    folder.save("a", "key", some_features())
    assert folder.load("a", "other") is None
    good = (tmp_path / "a.npz").read_bytes()
    for bad in (b"", b"text", good[: len(good) // 2], good[:300] + b"\0" * 40 + good[340:]):
        (tmp_path / "a.npz").write_bytes(bad)
        refuses(ChangedRecord, r"a\.npz: ", folder.load, "a", "key")


def test_the_manifest_ends_a_stage_and_removes_stale_files(tmp_path):
    folder = StageFolder(tmp_path)
    folder.save("old", "1", some_features())
    folder.save("new", "2", some_features())
    report = records.StageReport("features", 1.5, {"images": 1}, {"x": 0.5}, ("a warning",))
    folder.finish(report, {"kind": "k"}, {"new": "2"})
    assert not (tmp_path / "old.npz").exists()
    assert folder.finished({"new": "2"}) == report
    assert folder.finished({"new": "3"}) is None
    (tmp_path / "manifest.json").write_text("{")
    assert folder.finished({"new": "2"}) is None


def test_keys_distinguish_values_types_and_arrays():
    keys = [key_of(1), key_of("1"), key_of(1, 1), key_of(np.arange(3)), key_of(np.arange(3.0)), key_of(None)]
    assert len(set(keys)) == len(keys)
    assert key_of({"a": 1, "b": 2}) == key_of({"b": 2, "a": 1})
    refuses(TypeError, "plain values", key_of, object())


IDENTITY = {"seed": 0, "settings": {"features": {"max": 5}}, "images": {"a.jpg": "1", "b.jpg": "2"}}


def test_the_same_run_is_resumed_and_another_is_rejected_with_the_difference(tmp_path):
    directory = RunDirectory(tmp_path / "new" / "out")
    for _ in ("new", "the same"):
        with directory.claim(IDENTITY, overwrite=False):
            directory.adopt(IDENTITY, overwrite=False)
            directory.stage("01").save("a", "key", some_features())
    two = IDENTITY["images"]
    changed = [
        ({"settings": {"features": {"max": 6}}}, r"features\.max was 5 and is now 6"),
        ({"seed": 1}, "seed was 0 and is now 1"), ({"images": {"a.jpg": "1"}}, r"without 'b\.jpg'"),
        ({"images": two | {"b.jpg": "3"}}, r"a changed 'b\.jpg'"),
        ({"images": two | {"c.jpg": "4", "d.jpg": "5"}}, r"new 'c\.jpg' and 1 more"),
    ]  # fmt: skip
    for change, words in changed:
        with pytest.raises(UsageError, match=words), directory.claim(IDENTITY | change, overwrite=False):
            pass
    assert read_json(directory.path / "run.json") == IDENTITY
    with directory.claim(IDENTITY | changed[0][0], overwrite=True):
        assert directory.stage("01").load("a", "key") is not None


def test_cached_results_are_shared_by_key_and_replace_damaged_ones(tmp_path):
    one, two = (RunDirectory(tmp_path / name, tmp_path / "shared").stage("01-features") for name in "ab")
    one.save("00000", "key", some_features(2.0))
    assert two.load("00007", "other") is None
    found = two.load("00007", "key")
    assert bytes_from_record(found, "") == bytes_from_record(some_features(2.0), "")
    own, kept = two.path / "00007.npz", tmp_path / "shared" / "01-features" / "key.npz"
    for damaged in (own, kept):
        write_atomically(damaged, b"damaged")
        assert two.load("00007", "key") is not None
    write_atomically(own, b"damaged")
    refuses(ChangedRecord, "npz: ", two.load, "00007", "key")
    kept.unlink()
    one.save("00000", "key", some_features(2.0))
    own.unlink()
    assert two.load("00007", "key") is not None
    # Taken once, it is there whatever becomes of the others.
    kept.unlink(missing_ok=True)
    one.path.joinpath("00000.npz").unlink()
    assert two.load("00007", "key") is not None
    assert not list(tmp_path.rglob("*.partial"))
    # What is replaced in one run stays as it was in the others.
    two.save("00007", "new", some_features(3.0))
    one.save("00000", "key", some_features(2.0))
    assert two.load("00007", "new") is not None


def saved(path, record, *, packed=False, **arrays):
    """A file that is sealed, whatever it holds."""
    reported = json.dumps({"key": "k", "record": record}).encode()
    save = np.savez_compressed if packed else np.savez
    save(path, description=np.frombuffer(reported, dtype=np.uint8), **arrays)
    path.write_bytes(sealed(path.read_bytes()))
    return path


def refused(path, words="npz: "):
    refuses(ChangedRecord, words, read_record, path, "k")
    return True


REPORT = {"type": "StageReport", "fields": {"stage": "x", "seconds": 1.0}}


def test_only_records_are_made_and_nothing_is_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    assert read_record(saved(path, REPORT), "k").stage == "x"
    assert read_record(path, "other") is None
    for kind in ("Path", "annotations", "__builtins__", "field", "soup", "F64"):
        assert refused(saved(path, {"type": kind, "fields": {}}))
    assert refused(saved(path, {"array": "array0"}), "array0")
    np.savez(path, description=np.array([{"key": "key"}], dtype=object))
    path.write_bytes(sealed(path.read_bytes()))
    assert refused(path, "allow_pickle")
    assert read_record(saved(path, {"array": "array0"}, array0=np.arange(3)), "k").tolist() == [0, 1, 2]
    path = saved(tmp_path / "a.npz", REPORT, packed=True)
    assert refused(path, "not compressed")
    with zipfile.ZipFile(path, "w") as archive:
        # An array that claims to be larger than the machine.
        head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
        archive.writestr("description.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    path.write_bytes(sealed(path.read_bytes()))
    assert refused(path)


def test_records_changed_by_another_program_are_reported(tmp_path):
    """Also if it copies the seal."""
    path, tracks = (
        tmp_path / "a.npz",
        records.Tracks(np.zeros(3, np.int64), np.arange(3), np.ones((3, 2)), 1, 3),
    )
    path.write_bytes(bytes_from_record(tracks, "k"))
    assert read_record(path, "k").n_points == 3
    with np.load(path) as file:
        parts, seal = {name: file[name].copy() for name in file.files}, file.zip.comment
    parts["array2"][0, 0] = np.nextafter(1.0, 0.0)
    np.savez(path, **parts)
    assert refused(path, "seal")
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = seal
    assert refused(path, "seal")


def run(out, **options):
    reconstruct(photographs(3), out, config=fake_config(), threads=1, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The outputs of a run to the model, and how many files it wrote."""
    out = tmp_path_factory.mktemp("whole") / "out"
    with disk_ends(0, 0) as written:
        run(out)
    return outputs(out), written[0]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.55, 0.7, 0.85, 1.0])
def test_a_run_stopped_by_a_full_disk_resumes_and_keeps_what_is_good(share, whole, tmp_path):
    wanted, count = whole
    out = tmp_path / "out"
    with disk_ends(1 + round(share * (count - 1)), errno.ENOSPC), pytest.raises(OutputError) as refused:
        run(out)
    assert str(refused.value).endswith(
        "cannot be written: No space left on device; free space there, then repeat the command to resume "
        f"from {out}"
    )
    there = outputs(out)
    assert {name: wanted.get(name) for name in there} == there
    run(out)
    assert different(outputs(out), wanted) == ()
    # Rewritten on a full disk, no good file is lost or truncated.
    shutil.rmtree(out / "08-model")
    with disk_ends(1, errno.ENOSPC), pytest.raises(OutputError):
        run(out)
    there = outputs(out)
    assert {name: wanted.get(name) for name in there} == there
    assert "model.glb" in there


def test_the_command_reports_a_full_disk_in_one_sentence(tmp_path, monkeypatch, refused):
    runs = SmallRuns(tmp_path, 2, 128, "features")
    wanted = runs.whole(tmp_path / "whole")
    refusal = refused_at(runs, 3, errno.ENOSPC, wanted)
    assert refusal.faults_of_refusal() == ""
    assert "No space left on device; free space there" in refusal.message

    def compile_kernels(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device", "kernels/index.nbi")

    monkeypatch.setattr("thesisrecon.api.reconstruct.reconstruct", compile_kernels)
    said = refused(["reconstruct", tmp_path / "images", "-o", tmp_path / "other"])
    sentence = "kernels/index.nbi cannot be written: No space left on device; free space there"
    assert said == f"thesisrecon: {sentence}\n"


IMAGES = 10


def test_a_folder_tells_its_stage_or_how_to_go_on(tmp_path, capsys):
    write_json(tmp_path / "run.json", {"images": {f"{i}.jpg": "" for i in range(IMAGES)}})
    pairs = np.array([(i, j) for i in range(IMAGES) for j in range(i + 1, IMAGES)])
    for name, count in {"01-features": IMAGES, "02-matches": 5}.items():
        (tmp_path / name).mkdir()
        for n in range(count):
            (tmp_path / name / f"{n:05d}.npz").touch()
    choice = StageFolder(tmp_path / "02-pairs")
    choice.save("choice", "key", records.PairChoice(pairs, "all"))
    choice.finish(records.StageReport("pairs", 0.0, {}, {}, ()), {}, {"choice": "key"})
    assert run_position(tmp_path) == "interrupted: matches, 5 of 45 done; repeat the command to resume"
    with RunDirectory(tmp_path).claim({}, overwrite=True):
        assert run_command(["inspect", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "running: matches, 5 of 45 done\n"
    assert run_position(tmp_path / "01-features") == ""


def test_records_of_a_replaced_run_are_not_counted(tmp_path, monkeypatch):
    def again(images, **options):
        return reconstruct(photographs(images), tmp_path, config=fake_config(), threads=1, **options)

    again(4)
    refuses(KeyboardInterrupt, None, again, 5, seed=1, overwrite=True, progress=interrupt_at("matches", 2))
    assert run_position(tmp_path) == "interrupted: matches, 2 of 10 done; repeat the command to resume"
    # Killed while it compiles: what the run had done before still counts.
    with monkeypatch.context() as patch:
        patch.setattr(algorithm1, "precompile", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        refuses(KeyboardInterrupt, None, again, 5, seed=1)
    assert run_position(tmp_path) == "interrupted: matches, 2 of 10 done; repeat the command to resume"
    refuses(KeyboardInterrupt, None, again, 5, seed=1, progress=interrupt_at("matches", 3))
    assert run_position(tmp_path) == "interrupted: matches, 3 of 10 done; repeat the command to resume"


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    words = r"holds 'letter\.txt', which thesisrecon did not create"
    directory = RunDirectory(tmp_path)
    with pytest.raises(UsageError, match=words), directory.claim(IDENTITY, overwrite=True):
        pass
    assert not (tmp_path / "run.json").exists()
