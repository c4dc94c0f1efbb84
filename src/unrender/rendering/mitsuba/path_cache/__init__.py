"""Paths that stay in memory, to be evaluated at other values of the parameters."""
