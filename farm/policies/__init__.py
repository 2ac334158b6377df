"""Policies: parameters and observations to actions."""
