"""The farm: what is learned, and how learner and workers speak."""
