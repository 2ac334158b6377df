"""The Rerun recording of a run; the only door to rerun, which is an extra: import its modules when they are needed."""
