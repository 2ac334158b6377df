"""Policies: they map parameters and observations to actions."""
