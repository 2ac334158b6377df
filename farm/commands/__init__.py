"""Commands that belong neither to the learner nor to workers: status, router, certificates."""
