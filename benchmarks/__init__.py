"""The benchmarks: `python -m benchmarks` lists them, `python -m benchmarks rcv.fig4_order` runs one.

A benchmark is a folder with four files:

    run.py     `run(...)` measures; its parameters are the command's options. `QUICK`: toy sizes for `--quick`.
    plot.py    `plot(record)` makes the figure (left out where there is none).
    table.py   `table(record)` makes the Markdown of the benchmark page.
    notes.md   the section's title, and the findings.

`benchmarks.runner` does everything else; the other modules here are measurements that several benchmarks share.
"""
