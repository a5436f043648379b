"""Validation: what may be promised of a model, from recordings that were left out of the fit.

May import every room above: base to identification.
"""
