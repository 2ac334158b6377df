"""The commands of the front door, a module each; they alone know learner and workers."""
