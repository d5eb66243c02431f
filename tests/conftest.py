"""Shared fixtures; files with slow tests start first, so that workers finish together."""

from tests.clusters import dask_cluster

__all__ = ["dask_cluster"]


def pytest_collection_modifyitems(items):
    """Move files with a slow test to the front."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
