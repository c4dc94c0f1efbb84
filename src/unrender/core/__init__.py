"""What every floor uses: arrays, trees, seeds, checks, errors, the registry of components."""
