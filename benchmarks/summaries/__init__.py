"""What docs/results.md says of the benchmarks, by subject."""
