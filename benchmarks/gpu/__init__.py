"""A plan of measurements for a GPU, in slices of at most ten minutes: `python -m benchmarks gpu`.

plan.py       the slices: which benchmark with which options
states.py     what became of each, one file a slice, in records/
execute.py    runs a slice's commands within its minutes
outcomes.py   pytest's plug-in that records each test's outcome, and leaves out those that have one
cli.py        the command
page.py       the list, and what benchmark pages show beside the figures of the CPU
"""
