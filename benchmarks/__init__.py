"""The benchmarks: `python -m benchmarks` lists them, `python -m benchmarks rcv.fig4_order` runs one.

A benchmark is a folder with two files:

    run.py    `run(...)` measures; its parameters are the command's options. `QUICK`: toy sizes for `--quick`.
              `table(record)` makes the Markdown of its page, `plot(record)` its figure where it has one.
    notes.md  the section's title, and the findings.

`benchmarks.runner` does everything else; the other modules here are measurements that several benchmarks share.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads that wait for one another count as the processor's time
