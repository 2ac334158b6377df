"""Simulation and pictures of it; knows no task."""
