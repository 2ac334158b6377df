"""The learner: runs a search algorithm, distributes jobs, saves, records and displays the run."""
