"""Linear algebra of public calls runs in one thread, whatever the environment says."""

import json
import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import json, sys
import numpy as np
from thesisrecon import reconstruct
from thesisrecon.runtime._blas import _libraries, one_blas_thread

threads = lambda: [get() for get, _ in _libraries()]
before, during = threads(), []
images = [np.random.default_rng(i).integers(0, 256, (96, 128), dtype=np.uint8) for i in range(3)]
reconstruct(images, sys.argv[1], until="features", progress=lambda *_: during.append(threads()))
with one_blas_thread():
    with one_blas_thread():
        pass
    during.append(threads())
print(json.dumps([before, during, threads()]))
"""


def test_a_run_uses_one_thread_of_blas_and_gives_the_others_back(tmp_path: Path) -> None:
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "out")], env=kept | {"OPENBLAS_NUM_THREADS": "2"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    before, during, after = json.loads(run.stdout)
    assert before == after == [2, 2]
    assert len(during) > 3
    assert all(threads == [1, 1] for threads in during)
