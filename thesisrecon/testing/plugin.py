"""Plugin of pytest: the marker ``accuracy_gate``, fixtures with truth, and a summary of what gates see.

It is named in a conftest.py and not found by itself: pytest rewrites the assertions of all modules of a
package that registers a plugin, which would change the digests of our code and so the keys of stored results.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from thesisrecon.testing import _SEEN, POWER, TwoViews, courtyard, two_views


@pytest.fixture(scope="session")
def thesisrecon_courtyard() -> tuple[list[Path], dict[str, Any]]:
    """Six images and their true cameras: ``thesisrecon.testing.courtyard``."""
    return courtyard()


@pytest.fixture
def thesisrecon_two_views() -> Callable[..., TwoViews]:
    """The function ``thesisrecon.testing.two_views``."""
    return two_views


def pytest_configure(config: Any) -> None:
    """Declare the marker of a gate whose numbers were measured."""
    config.addinivalue_line(
        "markers",
        "accuracy_gate(sees, noise, limit): a gate is there to see an error of `sees`; where repeated runs "
        "differ by the standard deviation `noise`, its `limit` must be small enough, else collection fails",
    )


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Refuse gates that would let an error of `sees` pass."""
    blind = []
    for item in items:
        for mark in item.iter_markers("accuracy_gate"):
            try:
                wanted, noise, limit = (float(mark.kwargs[name]) for name in ("sees", "noise", "limit"))
            except (KeyError, TypeError, ValueError):
                raise pytest.UsageError(
                    f"{item.nodeid}: accuracy_gate takes numbers sees, noise and limit"
                ) from None
            if limit + POWER * noise > wanted:
                seen = f"sees {limit + POWER * noise:.3g}, which is more than {wanted:g}"
                blind.append(f"{item.nodeid} {seen}: lower its limit ({limit:g}) or its noise ({noise:g})")
    if blind:
        raise pytest.UsageError("\n".join(["accuracy gates that let an error of their `sees` pass:", *blind]))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say what the assertions of this run would have seen."""
    if _SEEN:
        terminalreporter.section("accuracy gates (smallest error seen in 95 of 100 cases)")
        for line in dict.fromkeys(_SEEN):
            terminalreporter.line(line)
