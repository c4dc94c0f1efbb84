"""A result judged by photographs that it was not made from, under other light, and from all around."""
