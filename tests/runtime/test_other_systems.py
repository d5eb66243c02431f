"""A run without the calls that only POSIX has, as on Windows."""

import json
import subprocess
import sys

from thesisrecon import sample

WITHOUT_POSIX = """
import multiprocessing.pool, multiprocessing.resource_tracker, os, signal, subprocess, sys, tempfile
import numba, numpy, PIL.Image, scipy.linalg
for name in ("fcntl", "resource", "pwd", "grp"):
    sys.modules[name] = None
for name in "O_NOFOLLOW O_NONBLOCK O_DIRECTORY getuid uname register_at_fork set_blocking".split():
    delattr(os, name)
for name in ("pthread_sigmask", "sigwait"):
    delattr(signal, name)
from thesisrecon.cli.commands import run_command
images, out = sys.argv[1:]
command = ["reconstruct", images, "-o", out, "--max-size", "200", "--threads", "1", "--until", "features"]
codes = [run_command(command), run_command(["inspect", out]), run_command([*command, "--seed", "1"])]
codes.append(run_command([*command, "--overwrite"]))
print(codes)
"""


def test_a_run_is_written_read_refused_and_replaced_without_posix(tmp_path):
    images = sample("courtyard") / "images"
    command = [sys.executable, "-c", WITHOUT_POSIX, str(images), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[0, 0, 2, 0]"
    summary = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))
    assert summary["images"] == 14
    assert summary["peak_memory_mb"] is None
