"""Methods with other constants, so that a test needs less time or shows the effect of a constant."""


def with_constants(kind, **constants):
    """The class ``kind`` with other constants."""
    assert all(hasattr(kind, name) for name in constants)
    return type(kind.__name__, (kind,), constants)
