"""Formatting of numbers, charts and images for terminals, pages and notebooks."""
