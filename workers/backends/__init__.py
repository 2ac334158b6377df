"""Simulation backends of workers."""
