from pydantic import Field, PositiveFloat, PositiveInt

import unrender as ur
from unrender.methods.base import SCHEDULE_HELP, Options, parse_schedule


@ur.register(name="momentum")
class MomentumMethod(Options):
    """a fresh rendering each step, gradient descent with momentum"""

    spp: PositiveInt = Field(4, description="samples per pixel")
    learning_rate: PositiveFloat = Field(0.1, description="step size of the parameters that have none of their own")
    momentum: float = Field(0.9, ge=0, lt=1, description="decay of the velocity")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)

    def build(self):
        schedule = parse_schedule(self.schedule)
        return ur.PathGradient(spp=self.spp), ur.optimizers.SGD(self.learning_rate, self.momentum, schedule)
