"""Plants: simulated machines for examples and tests, and the paper's experiment.

May import every room above: base to reports.
"""
