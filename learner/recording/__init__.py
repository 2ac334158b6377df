"""The Rerun recording of a run.

Only this package uses rerun, an extra: import its modules when they are needed.
"""
