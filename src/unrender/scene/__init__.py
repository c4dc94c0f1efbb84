"""What is to be recovered, and from which images."""
