"""Identification of the uncertain linear model from recorded transients."""

from uncertain_lti.identification.fitting import fit as fit

__all__ = ["fit"]
