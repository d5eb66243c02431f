"""Sections 1.2, 1.3 and 2.6: new views of a model or between photographs."""
