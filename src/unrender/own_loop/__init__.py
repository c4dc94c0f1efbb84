"""A renderer for loops that people write themselves: images to their loss, gradients to their optimizer."""
