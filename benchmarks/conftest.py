"""What the benchmarks work on, made once; every library gets one thread."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from thesisrecon.io.images import read_photographs
from thesisrecon.types import Image
from validation.references.libraries import NoReference, one_thread
from validation.scenes.real import load_fixture_scene

Bench = Callable[[str, str, Callable[[], Any]], None]


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    with suppress(NoReference):
        one_thread()


@pytest.fixture(scope="session")
def photographs() -> tuple[Image, ...]:
    """Two neighbours of the courtyard."""
    return read_photographs(load_fixture_scene().image_paths[5:7], max_size_px=1024).images


@pytest.fixture
def bench(benchmark: Any) -> Bench:
    """``bench(group, method, call)``: measured after one call that compiles and fills the caches; skipped
    where the reference library is missing."""

    def run(group: str, method: str, call: Callable[[], Any]) -> None:
        benchmark.group, benchmark.extra_info["method"] = group, method
        try:
            call()
        except NoReference as error:
            pytest.skip(f"{group}, {method}: {error}")
        benchmark(call)

    return run


@pytest.fixture(scope="session")
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
