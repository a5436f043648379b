# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Containers: what a file of ROS messages is by its first bytes, and what is in it."""

from __future__ import annotations

from pathlib import Path

from uncertain_lti.recordings import mcap_index, mcap_scan
from uncertain_lti.recordings.foreign import scan_foreign
from uncertain_lti.recordings.mcap_records import Contents
from uncertain_lti.recordings.unreadable import os_error


def scan(path: Path) -> Contents:
    """Go through a file once and note where its messages are."""
    return _foreign(path) or mcap_scan.scan(path)


def outline_or_scan(path: Path) -> Contents:
    """What the index of an MCAP file states, or else what is found by `scan`."""
    return _foreign(path) or mcap_index.outline_or_scan(path)


def _foreign(path: Path) -> Contents | None:
    try:
        return scan_foreign(path)
    except OSError as error:
        raise os_error(path, error) from None
