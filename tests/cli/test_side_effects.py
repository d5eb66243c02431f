"""What the package needs, holds and writes: dependencies with bounds, images of the demo, files of a run."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from thesisrecon.io._images import demo_images

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
AUDIT = """
import os, sys
log = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
PATHS = {"os.mkdir": 1, "os.rename": 2, "os.link": 2, "os.symlink": 2, "os.remove": 1, "os.rmdir": 1,
         "os.truncate": 1, "os.chmod": 1, "os.chown": 1, "os.utime": 1}
NETWORK = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo", "socket.gethostbyname",
           "socket.gethostbyaddr", "urllib.Request", "webbrowser.open")
PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn")
def write(kind, text):
    os.write(log, f"{kind}\\t{text}\\n".encode(errors="replace"))
def log_event(event, given):
    if event == "open" and not isinstance(given[0], int) and given[2] & WRITING:
        write("write", os.path.abspath(os.fsdecode(given[0])))
    elif event in PATHS:
        for path in given[:PATHS[event]]:
            if not isinstance(path, int):
                write("write", os.path.abspath(os.fsdecode(path)))
    elif event in NETWORK:
        write("network", f"{event} {given[1:]}")
        raise PermissionError(f"{event} is forbidden here")
    elif event in PROGRAMS and given[0] != sys.executable:  # kernels are compiled in processes of Python
        write("program", f"{event} {given[0]}")
sys.addaudithook(log_event)
from thesisrecon.cli.commands import main
sys.argv[0] = "thesisrecon"
main()
"""
"""Program that logs every path that a command writes, and its network calls and programs."""


def test_the_wheel_has_the_images_of_the_demo():
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    for source, target in included.items():
        assert target == f"thesisrecon/{source}"
        assert (ROOT / source).is_dir()
    assert len(demo_images()) == 6
    assert all(any(path.is_relative_to(ROOT / source) for source in included) for path in demo_images())


def test_a_run_writes_only_into_its_folder_and_opens_no_connection(tmp_path):
    """Home, temporary and current folder stay empty, also of files that C code would write."""
    images, result, log, watched = (tmp_path / name for name in ("images", "result", "log", "watched"))
    images.mkdir()
    for path in demo_images()[:3]:
        shutil.copy(path, images)
    homes = {name: watched / name for name in ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "cwd")}
    for folder in homes.values():
        folder.mkdir(parents=True)
    command = ["reconstruct", str(images), "-o", str(result), "--max-size", "400"]
    command += ["--set", "dense.max_side=160", "--set", "dense.match_side=160"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment |= {name: str(folder) for name, folder in homes.items()}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(ROOT)}
    subprocess.run(
        [sys.executable, "-c", AUDIT, str(log), *command], cwd=homes["cwd"], env=environment, check=True
    )
    events = [line.split("\t", 1) for line in log.read_text(encoding="utf-8").splitlines()]
    assert [event for event in events if event[0] != "write"] == []
    written = {Path(path).resolve() for _, path in events}
    # The cache of kernels stands beside the code where that can be written.
    caches = [path for path in (ROOT / "thesisrecon").rglob("__pycache__") if path.is_dir()]
    allowed = [folder.resolve() for folder in (result, Path(os.devnull), *caches)]
    assert [p for p in written if not any(p.is_relative_to(place) for place in allowed)] == []
    assert sum(p.is_relative_to(result.resolve()) for p in written) > 10
    assert (result / "report.html").is_file()
    assert [p for folder in homes.values() for p in folder.rglob("*")] == []
