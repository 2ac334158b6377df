"""A learnt policy on perturbed starts."""
