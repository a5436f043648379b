"""Identification: recorded transients into a model by criteria (10) and (11), to a proven optimum.

May import base, signals, recordings, sampling and model.
"""

from uncertain_lti.identification.fitting import fit as fit

__all__ = ["fit"]
