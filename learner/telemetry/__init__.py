"""Reports of a run: published, followed, kept."""
