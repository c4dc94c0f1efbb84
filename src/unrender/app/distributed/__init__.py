"""Distributed runs: a problem's views are distributed to workers, and each computes its part of every step."""
