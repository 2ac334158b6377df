"""Loggers: a run's curves in the tools that people already have, one class each."""
