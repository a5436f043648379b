# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The programs that run as nodes; what they need and is not installed is one sentence, and no traceback."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from importlib import import_module

from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti_ros import endings, hold_middleware

_BAD_USAGE, _FAULT = 2, 70


def envelope_monitor() -> int:
    """The live monitor."""
    return _run("envelope_monitor", "main")


def plant() -> int:
    """The published engine."""
    return _run("plant", "plant")


def turbofan() -> int:
    """The nonlinear engine."""
    return _run("plant", "turbofan")


def _run(module: str, function: str) -> int:
    name = module if function == "main" else function
    for number in endings():  # until `living` takes them over, a second later
        signal.signal(number, lambda *_: os._exit(0))
    try:
        hold_middleware()
        return int(getattr(import_module(f"uncertain_lti_ros.{module}"), function)())
    except UncertainLTIError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return _BAD_USAGE
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        absent = isinstance(error, ModuleNotFoundError) and package
        what = f"the Python package {package} is not installed" if absent else str(error).partition("\n")[0]
        remedy = "source a ROS 2 Jazzy installation, or in the checkout: pip install '.[ros]'"
        print(f"{name}: {what}; {remedy}", file=sys.stderr)
        return _BAD_USAGE
    except Exception:  # a traceback alone would end with 1, which means an alarm elsewhere
        traceback.print_exc()
        print(f"{name}: this is a fault of the program; please report it with the lines above", file=sys.stderr)
        return _FAULT
