"""From images to an estimate of the loss gradient."""
