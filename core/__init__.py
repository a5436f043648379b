# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bounded-uncertainty linear models of a plant, fitted to recorded transients and watched live.

The public names are imported on first use (PEP 562), so that importing the package costs nothing and the
live monitor never loads a solver, a plotting library or a bag reader.
"""

from importlib import import_module
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uncertain_lti.model.operating_point import OperatingPoint as OperatingPoint
    from uncertain_lti.model.uncertain_lti import UncertainLTI as UncertainLTI
    from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor as EnvelopeMonitor
    from uncertain_lti.proposal.public_fit import fit as fit
    from uncertain_lti.proposal.tune import tune as tune
    from uncertain_lti.sampling.reading import read_transients as read_transients
    from uncertain_lti.sampling.transient import Transient as Transient
    from uncertain_lti.signals.signal_map import SignalMap as SignalMap
    from uncertain_lti.validation.left_out import validate as validate

__version__ = "0.2.0"

if not any((Path(__file__).parent / f"kernel/arithmetic{ending}").exists() for ending in EXTENSION_SUFFIXES):
    raise ImportError(
        "uncertain_lti is not compiled for this Python; install a wheel, or a C compiler and Python's headers and say "
        "`pip install -e .` where its setup.py is"
    )

_HOME = {
    "EnvelopeMonitor": "monitor.envelope_monitor",
    "OperatingPoint": "model.operating_point",
    "SignalMap": "signals.signal_map",
    "Transient": "sampling.transient",
    "UncertainLTI": "model.uncertain_lti",
    "fit": "proposal.public_fit",
    "read_transients": "sampling.reading",
    "tune": "proposal.tune",
    "validate": "validation.left_out",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
