"""A search over a method's options: what to try, what to give up early, what was found."""

from unrender.sweeps.axes import Axis
from unrender.sweeps.pruning import Pruning
from unrender.sweeps.record import SweepRecord, TrialRecord, read_sweep
from unrender.sweeps.search import Grid, Random, Search
from unrender.sweeps.trials import Trials

__all__ = ["Axis", "Grid", "Pruning", "Random", "Search", "SweepRecord", "TrialRecord", "Trials", "read_sweep"]
