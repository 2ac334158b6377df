"""Experiments as data: which runs, which question, which figure, and what the thesis says came out."""
