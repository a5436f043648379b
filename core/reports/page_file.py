"""The file of the page that `report` writes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import target, whole_file
from uncertain_lti.recordings.recording import Recording


def page_target(output: str | os.PathLike[str] | None, model_file: str, bags: Sequence[Recording]) -> Path | None:
    """Where the page goes; an older page gives way, a recording or the model never.

    Parameters
    ----------
    output : path or None
        What the user named; None for no page.
    model_file : str
        The model, which is never replaced.
    bags : sequence of Recording
        The recordings, which are never replaced.

    Returns
    -------
    Path or None
        The path, or None if none is asked for.

    Raises
    ------
    BagError
        The place is one of them, or its folder is not there.
    """
    if output is None:
        return None
    path = Path(output)
    for other in (Path(model_file), *(part for bag in bags for part in bag.parts)):
        if path.exists() and other.exists() and path.samefile(other):
            raise BagError(f"{path}: is what the report is about; choose another name")
    return target(path, holds=b"<html", kind="page", example="report.html")


def write_page(path: str | os.PathLike[str], page: str) -> None:
    """Write a page, whole or not at all.

    Parameters
    ----------
    path : path
        The file.
    page : str
        Its text; what UTF-8 cannot hold is replaced.

    Raises
    ------
    BagError
        The file cannot be written.
    """
    try:
        with whole_file(path) as stream:
            stream.write(page.encode("utf-8", "replace"))
    except OSError as error:
        raise BagError(f"{path}: cannot be written: {error.strerror}; choose another place") from None
