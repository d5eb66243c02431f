"""Adapters to the reference libraries."""
