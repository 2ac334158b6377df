"""Who simulates: a worker joins the farm, takes pairs, runs them, answers."""
