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

FAULT, INTERRUPTED = 70, 130
"""Exit statuses: of a fault of the program itself, and of an interrupt; here, as nothing need be imported for them."""


def begin() -> int:
    """Import the program and run it: one that cannot be imported never ends with the exit status of an alarm."""
    try:
        from uncertain_lti.cli.main import main as run
    except KeyboardInterrupt:
        print("uncertain-lti: interrupted before anything was begun", file=sys.stderr)
        return INTERRUPTED
    except Exception:
        import traceback

        traceback.print_exc()
        print("uncertain-lti: the installation is damaged; install uncertain-lti-ros again", file=sys.stderr)
        return FAULT
    return run()
