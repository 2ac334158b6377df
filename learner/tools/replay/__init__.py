"""A run's policies and rollouts, simulated again."""
