"""Sweeps over the options of a method: the search, the early stopping of runs, and the record of the results."""

from unrender.app.sweeps.axes import Axis
from unrender.app.sweeps.pruning import Pruning
from unrender.app.sweeps.record import SweepRecord, TrialRecord, read_sweep
from unrender.app.sweeps.search import Grid, Random, Search
from unrender.app.sweeps.trials import Trials

__all__ = ["Axis", "Grid", "Pruning", "Random", "Search", "SweepRecord", "TrialRecord", "Trials", "read_sweep"]
