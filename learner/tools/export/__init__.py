"""A learnt policy in a file of its own."""
