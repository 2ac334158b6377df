"""What a worker simulates with."""
