"""Every executor gives the same bytes, and a run survives the loss of workers."""

import concurrent.futures as futures
import gc
import hashlib
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from tests.conftest import LOCAL, address, refuses
from tests.pipeline import fake_stages as fakes
from tests.pipeline.fake_stages import fake_config, photographs
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.errors import UsageError, WorkersLost
from thesisrecon.io._files import read_json
from thesisrecon.pipeline import matching
from thesisrecon.runtime import _executors as workers
from thesisrecon.runtime._executors import Workers

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
NO_RESULT = ("seconds", "elapsed_seconds", "peak_memory_mb", "threads", "executor", "resumed")
"""What a summary says of how it came about."""


def results(out):
    """Every result file of a run by its hash, and its summary without times."""
    files = [
        *out.glob("0*/*.npz"), *(out / "sparse").rglob("*.bin"), *out.glob("*.ply"), out / "cameras.json",
    ]  # fmt: skip
    found = {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(files)}
    model = out / "model.glb"
    found["model"] = hashlib.sha256(model.read_bytes()).hexdigest() if model.exists() else ""
    summary = read_json(out / "summary.json")
    return found | {"summary": {name: v for name, v in summary.items() if name not in NO_RESULT}}


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Four photographs of the courtyard, and their run with one worker."""
    place = tmp_path_factory.mktemp("serial")
    images = sorted(COURTYARD.iterdir())[4:8]
    small_job(images, place / "out", threads=1)
    return images, place / "out"


def small_job(images, out, **options):
    config = replace(PipelineConfig(), images=ImageOptions(max_size_px=200))
    reconstruct(images, out, config=config, until="metric", **options)


@pytest.mark.parametrize("kind", ["threads", "processes", "dask", "shuffled"])
def test_the_sparse_job_gives_the_same_bytes_anywhere(kind, serial, tmp_path, request):
    images, out = serial
    if kind == "shuffled":
        images = [images[k] for k in np.random.default_rng(3).permutation(len(images))]
        assert images != serial[0]
    executor = {"processes": "processes", "dask": ""}.get(kind, "local")
    if kind == "dask":
        executor = address(request.getfixturevalue("dask_cluster"))
    small_job(images, tmp_path, threads=2, executor=executor)
    assert results(tmp_path) == results(out)
    assert read_json(tmp_path / "summary.json")["executor"] == executor


def test_surfaces_have_the_same_bytes_on_a_cluster_and_in_an_executor_of_ones_own(dask_cluster, tmp_path):
    """Through all that fans out, with fake stages."""
    given = {"config": fake_config(), "threads": 2}
    reconstruct(photographs(4), tmp_path / "a", **given)
    reconstruct(photographs(4), tmp_path / "b", executor=address(dask_cluster), **given)
    with futures.ThreadPoolExecutor(2) as pool:
        reconstruct(photographs(4), tmp_path / "c", executor=pool, **given)
        assert pool.submit(int).result() == 0, "an executor of the caller's is not shut down"
    assert results(tmp_path / "a")["model"]
    assert results(tmp_path / "a") == results(tmp_path / "b") == results(tmp_path / "c")
    assert read_json(tmp_path / "c" / "summary.json")["executor"] == "ThreadPoolExecutor"


@dataclass(frozen=True)
class DeadlyMatcher(fakes.FakeMatcher):
    """Kills the process it works in, once: when it comes to a pair and the file is not there."""

    reported: str = ""
    fatal: tuple[int, int] = (1, 2)

    def match(self, view1, view2, *, pair, estimate_fundamental, rng):
        if tuple(pair) == self.fatal:
            try:
                os.close(os.open(self.reported, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().match(view1, view2, pair=pair, estimate_fundamental=estimate_fundamental, rng=rng)


def deadly(tmp_path):
    return fake_config(matching=DeadlyMatcher(reported=str(tmp_path / "killed")))


def undisturbed(tmp_path):
    (tmp_path / "killed").touch()
    reconstruct(photographs(4), tmp_path / "whole", config=deadly(tmp_path), until="metric", threads=1)
    (tmp_path / "killed").unlink()
    return results(tmp_path / "whole")


def test_a_worker_of_a_cluster_that_is_killed_is_named_and_loses_nothing(dask_cluster, tmp_path, caplog):
    whole = undisturbed(tmp_path)
    executor, config = address(dask_cluster), deadly(tmp_path)
    reconstruct(photographs(4), tmp_path / "out", config=config, until="metric", executor=executor)
    assert (tmp_path / "killed").exists()
    assert re.search(r"1 of \d Dask workers were lost: others do their tasks", caplog.text)
    assert results(tmp_path / "out") == whole


def test_a_killed_worker_process_is_reported_and_the_run_continues(tmp_path):
    whole, config = undisturbed(tmp_path), deadly(tmp_path)
    given = {"config": config, "until": "metric", "threads": 2, "executor": "processes"}
    with pytest.raises(
        WorkersLost, match=r"ended unexpectedly .* \(in the stage matches\).* repeat the command to resume"
    ):
        reconstruct(photographs(4), tmp_path / "out", **given)
    reconstruct(photographs(4), tmp_path / "out", **given)
    assert results(tmp_path / "out") == whole


@dataclass(frozen=True)
class AlwaysDeadlyMatcher(fakes.FakeMatcher):
    """Kills its process at one pair, as a task does that needs too much memory."""

    def match(self, view1, view2, *, pair, **given):
        if tuple(pair) == (1, 2) and multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().match(view1, view2, pair=pair, **given)


def test_a_task_that_kills_every_worker_names_its_images_and_what_to_do(tmp_path):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    given = {"config": fake_config(matching=AlwaysDeadlyMatcher()), "until": "metric"}
    images = photographs(4)
    words = (
        r"2 Dask workers died .* more memory than their 1 GiB: start workers .*; it was for "
        rf"{images[1].name}, {images[2].name} \(in the stage matches\).* repeat the command to resume"
    )
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=1, memory_limit="1GiB", **LOCAL) as running,
    ):
        refuses(WorkersLost, words, reconstruct, images, tmp_path, executor=address(running), **given)
    assert reconstruct(images, tmp_path, **given).metric is not None


def test_workers_that_start_late_are_awaited_as_long_as_the_address_says(monkeypatch, caplog):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "ANSWER_S", 3.0)
    found = []
    with distributed.LocalCluster(n_workers=0, processes=False, protocol="tcp://", **LOCAL) as running:
        place = address(running)
        soon, later = (Workers(1, f"{place}?wait={seconds}") for seconds in (1, 60))
        refuses(UsageError, r"no workers after 1 s; .* \?wait=SECONDS", soon.run, abs, [(-1,)], found.append)
        threading.Timer(4.0, running.scale, [1]).start()
        later.run(abs, [(-1,)], lambda _, result: found.append(result))
    assert found == [1]
    assert "has no workers yet: waiting 60 s" in caplog.text


def clients():
    """Numbers of the clients of Dask in memory; those of other tests may be among them."""
    return {id(found) for found in gc.get_objects() if type(found).__name__ == "Client"}


def test_a_cluster_with_certificates_is_used_and_missing_ones_are_named(tmp_path):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    if (openssl := shutil.which("openssl")) is None:
        pytest.skip("openssl is not installed")
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "certificate.pem")
    command = [openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=test", "-days", "2"]
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    found, place = [], "distributed.comm.tls"
    tls = {f"{place}.{role}.key": key for role in ("scheduler", "worker", "client")}
    tls |= {name.replace(".key", ".cert"): certificate for name in tls} | {f"{place}.ca-file": certificate}
    with dask.config.set(tls):
        security = distributed.Security()
    cluster = {"n_workers": 1, "processes": False, "security": security, "protocol": "tls://", **LOCAL}
    with distributed.LocalCluster(**cluster) as running:
        one, before = Workers(1, running.scheduler_address), clients()
        words = "needs certificates in the configuration of Dask"
        refuses(UsageError, f"{words}.*no key or certificate", one.run, abs, [(-1,)], None)
        absent = {name: str(tmp_path / "absent.pem") for name in tls}
        with dask.config.set(absent):
            refuses(UsageError, f"{words}.*No such file", one.run, abs, [(-1,)], None)
        # Its finalizer can block the start of the next client for ten seconds.
        assert clients() <= before
        with dask.config.set(tls):
            one.run(abs, [(-1,)], lambda _, result: found.append(result))
    assert found == [1]


@pytest.fixture
def lonely():
    """A scheduler and its worker in this process, to be closed in the middle."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, processes=False, protocol="tcp://", **LOCAL) as running:
        yield address(running), running


def test_a_scheduler_that_dies_is_reported_and_the_run_continues(lonely, tmp_path, monkeypatch):
    executor, running = lonely
    monkeypatch.setattr(workers, "ANSWER_S", 2.0)
    monkeypatch.setattr(workers, "CHECK_S", 0.5)

    def close_at_matches(stage, done, _):
        if stage == "matches" and done == 2:
            running.close()

    config = fake_config(matching=SlowMatcher())
    with pytest.raises(WorkersLost, match=r"scheduler at 127\.0\.0\.1:\d+ is gone \(in the stage matches\)"):
        reconstruct(
            photographs(4), tmp_path, config=config, until="metric", executor=executor,
            progress=close_at_matches,
        )  # fmt: skip
    assert len(list((tmp_path / "02-matches").glob("*.npz"))) >= 2
    result = reconstruct(photographs(4), tmp_path, config=config, until="metric")
    assert result.metric is not None


@dataclass(frozen=True)
class SlowMatcher(fakes.FakeMatcher):
    def match(self, *views, **given):
        time.sleep(0.2)
        return super().match(*views, **given)


@pytest.mark.parametrize("port", ["", "8786/x", "0", "70000", "port"])
def test_an_invalid_address_or_a_missing_extra_is_named_before_any_output(port, tmp_path, monkeypatch):
    given = {"config": fake_config(), "out": tmp_path / "out"}
    words = r"dask://HOST:PORT, for example .* got 'dask://there"
    refuses(UsageError, words, reconstruct, photographs(2), executor=f"dask://there:{port}", **given)
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = "not installed; install the extra distributed"
    refuses(UsageError, words, reconstruct, photographs(2), executor="dask://localhost:8786", **given)
    assert not (tmp_path / "out").exists()


def test_an_unreachable_scheduler_is_reported_on_the_command_line(monkeypatch, tmp_path, refused):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "ANSWER_S", 0.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = ["reconstruct", str(COURTYARD), "-o", str(tmp_path / "out")]
    said = refused([*command, "--executor", f"dask://127.0.0.1:{port}"])
    assert f"no Dask scheduler answers at 127.0.0.1:{port}" in said
    assert not (tmp_path / "out").exists()


def test_workers_of_other_versions_unknown_tasks_and_invalid_executors_are_refused():
    words = r"has thesisrecon 0.* \(\w{12}\), python .*, this program thesisrecon None"
    refuses(UsageError, words, workers._answer, {}, b"")
    other = workers._environment() | {"numpy": "1.0"}
    words = rf"has numpy {np.__version__}, this program numpy 1\.0; install"
    refuses(UsageError, words, workers._answer, other, b"")
    missing = b"cno_such_module\nfunction\n."
    with pytest.raises(UsageError, match="cannot load its task: No module named 'no_such_module'"):
        workers._answer(workers._environment(), missing)
    refuses(UsageError, "or a concurrent", Workers, 1, 3)


def test_an_executor_is_given_few_tasks_at_a_time():
    """Large sets must not lie in memory as tasks."""
    asked, done = [], []

    def tasks():
        for n in range(50):
            asked.append(n)
            assert len(asked) - len(done) <= 2 * workers.AHEAD + 2
            yield (n,)

    with futures.ThreadPoolExecutor(2) as pool:
        Workers(2, pool).run(abs, tasks(), lambda n, _: done.append(n))
    assert sorted(done) == asked == list(range(50))


def test_prepared_views_stay_within_their_memory_bound(monkeypatch):
    made = []

    def prepare(_, features):
        made.append(features)
        return np.zeros(100)

    monkeypatch.setattr(matching, "CACHE_BYTES", 4 * 800)
    views = matching.PreparedViews(prepare, {i: (None, i) for i in range(6)})
    assert [len(views[k]) for k in (0, 1, 2, 3, 4, 5, 5, 2, 0)] == [100] * 9
    assert made == [0, 1, 2, 3, 4, 5, 0]
    assert (len(views.subset([4, 5])), len(views.prepared_by(prepare)[0])) == (2, 100)
    assert made[7:] == [0]
    refuses(IndexError, "view 0 is not among", views.subset([4, 5]).__getitem__, 0)


@pytest.mark.parametrize(("views", "workers_there"), [(14, 2), (5, 4), (80, 2)])
def test_batches_hold_every_pair_once_and_few_views(views, workers_there):
    every = [(i, j) for i in range(views) for j in range(i + 1, views)]
    numbers = list(range(0, len(every), 2))
    dealt = matching.batch_pairs(every, numbers, workers_there, [3000] * views)
    assert sorted(n for batch in dealt for n in batch) == numbers
    assert len(dealt) >= min(len(numbers), 8 * workers_there)
    assert len({len(batch) for batch in dealt[:-1]}) == 1
    for batch in dealt:
        assert len(batch) <= matching.MAX_BATCH
        assert len({view for n in batch for view in every[n]}) <= 6 * len(batch) ** 0.5
    corners = int(matching.MAX_RESULT_BYTES / matching.MATCH_BYTES)
    assert {len(batch) for batch in matching.batch_pairs(every, numbers, 1, [corners] * views)} == {1}


def refuse(*_):
    raise RuntimeError("can't start new thread")


def test_without_further_threads_the_calling_thread_does_the_work(tmp_path, monkeypatch):
    """As with RLIMIT_NPROC and in containers: every stage, to the textured surface."""
    config = replace(PipelineConfig(), images=ImageOptions(max_size_px=160))
    images = sorted(COURTYARD.iterdir())[4:8]
    reconstruct(images, tmp_path / "usual", config=config, threads=2)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    reconstruct(images, tmp_path / "alone", config=config, threads=2)
    assert results(tmp_path / "alone") == results(tmp_path / "usual")
    assert results(tmp_path / "alone")["model"] != ""


@pytest.mark.parametrize("refused", ["processes", "threads"])
def test_without_worker_processes_this_process_does_the_work(refused, serial, tmp_path, monkeypatch, caplog):
    if refused == "threads":
        monkeypatch.setattr(threading.Thread, "start", refuse)
    else:
        busy = BlockingIOError(11, "Resource temporarily unavailable")
        monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", Mock(side_effect=busy))
    small_job(serial[0], tmp_path, threads=2, executor="processes")
    assert results(tmp_path) == results(serial[1])
    assert caplog.text.count("no worker processes can be started") == 1
