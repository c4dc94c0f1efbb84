"""Pixel mini-batches on a mesh."""
