"""Cached paths, which are evaluated again at other parameter values."""
