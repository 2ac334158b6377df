"""Recordings of runs, alone or together."""
