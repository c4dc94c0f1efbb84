"""A plan of measurements for a GPU, in slices of at most ten minutes: `python -m benchmarks gpu`.

plan.toml lists the slices, plan.py reads them and keeps what became of each in records/; execute.py runs a slice within its minutes;
cli.py is the command.
"""
