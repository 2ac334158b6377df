"""A table of runs."""
