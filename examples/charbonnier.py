from dataclasses import dataclass

import unrender as ur
from unrender.core import arrays, checks


@ur.register
@dataclass(frozen=True)
class Charbonnier(ur.losses.Loss):
    """√((I − R)² + ε²) − ε: L1 with a rounded tip. Noise biases its derivative.

    Args:
        epsilon: ε in radiance, > 0.
    """

    epsilon: float = 0.01
    linear = False
    pixelwise = True

    def __post_init__(self):
        checks.number("Charbonnier", "epsilon", self.epsilon, above=0.0)

    def value(self, image, reference):
        difference = image - reference
        return arrays.sqrt(difference * difference + self.epsilon**2) - self.epsilon

    def derivative(self, image, reference):
        difference = image - reference
        return difference / arrays.sqrt(difference * difference + self.epsilon**2)
