"""Simulation and rendering; independent of tasks."""
