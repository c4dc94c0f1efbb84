"""Methods by name: an estimator and an optimizer with their options."""
