"""Errors meant for a person: one sentence that names the file, topic or field, and the remedy."""

from __future__ import annotations

from uncertain_lti.base.english import printable


class UncertainLTIError(Exception):
    """Base of every error raised on purpose; the command line prints it without a traceback.

    Names in it may come from any file, so its text is one line without control characters.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class BagError(UncertainLTIError):
    """A recording cannot be found, opened, read or written."""


class SignalError(UncertainLTIError):
    """A signals file, a field path or a topic does not describe a number that can be read."""


class ModelError(UncertainLTIError):
    """A model file or the matrices of a model are not what the format allows."""


class TransientError(UncertainLTIError):
    """Arrays, a data frame or a CSV file do not form a transient."""


class FitError(UncertainLTIError):
    """The identification problem has no usable solution for this data."""
