"""A run's recording, over the network."""
