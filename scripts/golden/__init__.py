"""Golden trajectories: short descents, recorded once, that a change of the code's structure must not move.

`scripts.golden.cases` names the problems, the methods and the optimizers; `scripts.golden.cli` records and compares.
"""
