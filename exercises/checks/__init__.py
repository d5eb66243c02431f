"""Data, errors and usual mistakes of the exercises, a file each."""
