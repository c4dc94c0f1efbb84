"""Evaluation of a result: held-out photographs, another light, and turntable videos."""
