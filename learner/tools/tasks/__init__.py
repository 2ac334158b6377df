"""What can be learnt and with what; a task to start from."""
