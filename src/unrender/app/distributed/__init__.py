"""Distributed runs: a problem's views are distributed to workers, and each computes its part of every step.

Workers hold references, control variates and gradients of their views. The main process holds parameters, optimizer, history and
checkpoints. A step's traffic grows with the number of parameters, not of views.

| event | what happens |
|---|---|
| a worker dies or does not respond for 4 s, then for 8 s | others take its views and repeat its steps since the last checkpoint |
| a step of a worker does not end | the worker counts as lost after a minute and 50 times its usual step |
| workers do not start within a minute | the run begins without them; they join later |
| a worker is four times slower for five steps | its views move, and a new worker starts, three times per run at most |
| workers are lost five times in one step | the run ends; `unrender resume` continues from the last checkpoint |
| the main process or the head node dies | the same |
| memory does not suffice | the run is refused before the first step, with the size that would fit |
"""
