"""Warnings of `auto` over the suite's rows: which runs warn, and whether the warnings are true."""
