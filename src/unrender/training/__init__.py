"""The loop, what listens to it, and what it leaves behind."""
