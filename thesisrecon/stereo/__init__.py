"""Sections 2.5 and 2.6: dense correspondence of neighbouring views, and depth from it."""
