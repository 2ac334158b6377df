"""A run repeated, and compared to the last bit."""
