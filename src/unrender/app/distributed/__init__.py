"""One run over many workers: a problem's views are dealt to them, and each computes its part of every step."""
