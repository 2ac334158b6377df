"""Tasks: the simulation, the policy's observations and actions, and the reward."""
