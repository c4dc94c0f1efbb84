"""Differentiable renderer for user-written loops, with their own loss and optimizer."""
