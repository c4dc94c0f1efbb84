"""Sweeps over the options of a method: the search, the order of the trials, and the record of the results."""
