"""Learnt policies for use elsewhere."""
