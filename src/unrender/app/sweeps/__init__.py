"""A search over a method's options: what to try, what to give up early, what was found."""

from unrender.app.sweeps.axes import Axis
from unrender.app.sweeps.pruning import Pruning
from unrender.app.sweeps.record import SweepRecord, TrialRecord, read_sweep
from unrender.app.sweeps.search import Grid, Random, Search
from unrender.app.sweeps.trials import Trials

__all__ = ["Axis", "Grid", "Pruning", "Random", "Search", "SweepRecord", "TrialRecord", "Trials", "read_sweep"]
