"""Time warm calls."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from validation.metrics.record import Metric


def time_of_a_frame(scene: str, draw: Callable[[], Any], *, repeats: int, target_s: float) -> Metric:
    """Return minimum wall and processor seconds of ``repeats`` calls on two threads, after a warm-up call;
    processor time is less disturbed by other work."""
    wall, processor = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter(), time.process_time()
        draw()
        wall.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    values: dict[str, float | None] = {"wall, 2 threads": min(wall[1:]), "processor": min(processor[1:])}
    return Metric(scene, "time of a frame", "s", values, "processor", target=target_s)
