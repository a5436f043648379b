# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""ROS 2 nodes around ``uncertain_lti``: parameters, QoS, clocks and messages; no numerics of their own."""

import os
import signal
import sys
from pathlib import Path

from uncertain_lti.base.errors import UncertainLTIError


def endings() -> list[int]:
    """Signals that end a process in order; SIGHUP, of a terminal that was closed, unless it is ignored (`nohup`)."""
    closed = [] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *closed]


def hold_middleware() -> None:
    """Refuse a middleware that is not installed, for which rcl would end the process with status 102."""
    places = [Path(place) for place in (f"{sys.prefix}/lib", *os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep))]
    wanted = os.environ.get("RMW_IMPLEMENTATION") or "rmw"
    there = [any((place / f"lib{name}.so").exists() for place in places) for name in ("rmw", wanted)]
    if there == [True, False]:
        raise UncertainLTIError(f"RMW_IMPLEMENTATION is {wanted}, which is not installed here; unset it, or install it")
