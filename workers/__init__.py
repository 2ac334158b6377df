"""Workers: a worker joins the farm, receives jobs, simulates them, and returns the results."""
