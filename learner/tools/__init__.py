"""Tools for a run, beside learning it: one folder for each tool.

The learner imports none of them.
"""
