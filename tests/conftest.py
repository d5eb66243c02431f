"""What all tests share: files with long tests begin first, so that no worker is left alone with one."""

from tests.clusters import dask_cluster

__all__ = ["dask_cluster"]


def pytest_collection_modifyitems(items):
    """Files with a test that is marked slow come first, otherwise the order stays."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
