"""Sweeps over the options of a method: the search, the early stopping of runs, and the record of the results."""
