"""One self-contained HTML page a run, and the figures in it."""
