"""A learnt policy under other conditions than those it has learnt with."""
