"""What the benchmarks work on, made once; every library gets one thread."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import pytest

from thesisrecon.io._images import read_images
from thesisrecon.records import Image
from validation.references.libraries import NoReference, one_thread
from validation.scenes.real import load_fixture_scene

Call = Callable[..., Any]
ROUNDS = 7


class Bench(Protocol):
    def __call__(self, group: str, method: str, call: Call, setup: Call | None = None) -> None: ...


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    with suppress(NoReference):
        one_thread()


@pytest.fixture(scope="session")
def photographs() -> tuple[Image, ...]:
    """Two neighbours of the courtyard."""
    return read_images(load_fixture_scene().image_paths[5:7], max_size_px=1024).images


@pytest.fixture
def bench(benchmark: Any) -> Bench:
    """``bench(group, method, call)``: measured after one call that compiles and fills the caches; skipped
    where the reference library is missing. ``call`` takes what ``setup`` makes for each call, unmeasured."""

    def run(group: str, method: str, call: Call, setup: Call | None = None) -> None:
        benchmark.group, benchmark.extra_info["method"] = group, method

        def arguments() -> tuple[Any, ...]:
            return () if setup is None else (setup(),)

        try:
            call(*arguments())
        except NoReference as error:
            pytest.skip(f"{group}, {method}: {error}")
        if setup is None:
            benchmark(call)
        else:
            benchmark.pedantic(call, setup=lambda: (arguments(), {}), rounds=ROUNDS)

    return run


@pytest.fixture(scope="session")
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
