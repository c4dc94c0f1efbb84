"""A descent in stages: which parameters move in each, and what it begins with."""
