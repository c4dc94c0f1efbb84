from dataclasses import dataclass

import unrender as ur
from unrender.core import checks


@ur.register
@dataclass(frozen=True)
class InverseTime(ur.schedules.Schedule):
    """1 / (1 + step / half).

    Args:
        half: steps after which the factor is a half, > 0.
    """

    half: float

    def __post_init__(self):
        checks.number("InverseTime", "half", self.half, above=0.0)

    def __call__(self, step):
        return 1.0 / (1.0 + step / self.half)
