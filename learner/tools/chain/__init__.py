"""Learnt policies one after another."""
