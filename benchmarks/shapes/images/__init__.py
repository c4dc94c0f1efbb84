"""What the loss sees where a mesh moves."""
