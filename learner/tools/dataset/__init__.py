"""Episodes of a learnt policy as a data set."""
