# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command line: each command declared once; `uncertain-lti` starts here.

May import every room.
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

FAULT, INTERRUPTED = 70, 130
"""Exit statuses: of a fault of the program itself, and of a signal; here, as nothing need be imported for them."""
_interrupts: list[int] = []


def begin() -> int:
    """Import the program and run it: one that cannot be imported never ends with the exit status of an alarm."""
    if not sys.warnoptions:  # of a library, as numpy's of an overflow: with nothing that a reader could do
        warnings.simplefilter("ignore")
    try:
        import signal

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, _interrupt)
        from uncertain_lti.cli.main import main as run
    except (Exception, KeyboardInterrupt) as error:
        if interrupted(error):
            print("uncertain-lti: interrupted before anything was begun", file=sys.stderr)
            return INTERRUPTED
        import traceback

        traceback.print_exc()
        print("uncertain-lti: the installation is damaged; install uncertain-lti-ros again", file=sys.stderr)
        return FAULT
    return run()


def interrupted(error: BaseException) -> bool:
    """Whether it comes of an interrupt: what is being imported may turn one into an error of its own."""
    return bool(_interrupts) or isinstance(error, KeyboardInterrupt)


def _interrupt(number: int, frame: Any) -> None:
    _interrupts.append(number)
    raise KeyboardInterrupt
