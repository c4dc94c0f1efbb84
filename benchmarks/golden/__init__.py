"""Golden trajectories: short descents, recorded once, that a change of the code's structure must not move.

`benchmarks.golden.cases` names the problems, the methods and the optimizers; `benchmarks.golden.cli` records and compares.
"""
