"""A plain function as a task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from thesisrecon.config import PipelineConfig
from validation.ablation.study import Measure, Place, TaskFunction


@dataclass(frozen=True)
class FunctionTask:
    """A task of a plain ``function(config, scene, seed)`` that returns numbers by name."""

    function: TaskFunction
    measures: ClassVar[Sequence[Measure]] = ()

    def check(self, scene: str) -> None:
        """Accept every scene; the function checks its scenes."""

    def scene_key(self, scene: str) -> str:
        return scene

    def run(
        self,
        config: PipelineConfig,
        scene: str,
        seed: int,
        place: Place,
    ) -> Mapping[str, float]:
        return self.function(config, scene, seed)
