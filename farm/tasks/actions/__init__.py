"""What an action's numbers are and do: one file for each kind of action space."""
