"""Filters, rasterisation and resampling of images, and values computed when they are used."""
