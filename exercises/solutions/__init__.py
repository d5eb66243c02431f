"""Solutions of the exercises, a file each."""
