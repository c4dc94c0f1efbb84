"""Rules of `auto`: functions from the traits of a problem to a plan, or to a part of one, with its reason.

`paths.RULES` choose the gradient estimator; the first rule that returns a plan decides.
"""
