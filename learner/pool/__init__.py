"""Hands a round's jobs to workers that may join and leave, and collects the results."""
