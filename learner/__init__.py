"""The learner: runs a search algorithm, gives out jobs, saves, records and shows."""
