"""Tasks: what is simulated, what a policy sees and does, and what that is worth."""
