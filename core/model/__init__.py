"""Model: the uncertain linear model, its terms and one-step bounds, its file and what other tools make of it.

May import base, signals and sampling.
"""
