"""The farm: what is learned, and how learner and workers speak."""

__version__ = "0.2.0.dev0"
