# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recall: what lag, diff and rate take from the samples of a recorded run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import TransientError
from uncertain_lti.base.text import meant
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.field_path import Memory
from uncertain_lti.signals.signal_map import Signal, with_rules

Values = Array
Mask = NDArray[np.bool_]


def recall(values: Values, memory: Memory, dt: Values, opens: Mask) -> Values:
    """What each sample takes from the samples up to it, as the `Sampler` has it.

    `values` (N,): of the field itself; `dt` (N,): step that leads to each sample, s; that of the first of a segment
    does not count; `opens` (N,): the first sample of each segment; Returns (N,): naN where the segment has too few
    samples before.
    """
    place = np.arange(len(values))
    begin = np.maximum.accumulate(np.where(opens, place, 0)) if len(values) else place
    source = place - memory.samples
    past = np.where(source >= begin, values[np.maximum(source, 0)], math.nan)
    if memory.kind == "lag":
        return past
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return values - past if memory.kind == "diff" else (values - past) / dt


def with_memories(transient: Transient, memories: Mapping[str, tuple[str, Memory]]) -> Transient:
    """The same run with further controls that follow from earlier samples of its states and controls."""
    names = [*transient.state_names, *transient.control_names, *transient.scheduling_names]
    z = np.hstack([transient.x, transient.u])
    columns, added = [], []
    for name, (of, memory) in memories.items():
        if of not in names[: z.shape[1]]:
            there = names[: z.shape[1]]
            raise TransientError(
                f"{transient.name}: there is no '{of}'{meant(of, there)}; there are {', '.join(there)}"
            )
        if name in names:
            raise TransientError(f"{transient.name}: '{name}' is there already; choose another name")
        names.append(name)
        place = names.index(of)
        columns.append(_column(transient, z[:, place], memory))
        if transient.signals is not None:
            added.append(memory_of(transient.signals[place], memory, name))
    u = np.column_stack([transient.u, *columns])
    if transient.signals is not None:
        signals = replace(transient.signals, controls=(*transient.signals.controls, *added))
        signals = replace(
            signals, structure=with_rules(signals.structure, {name: of for name, (of, _) in memories.items()})
        )
        return transient.replace(u=u, signals=signals)
    return transient.replace(u=u, control_names=(*transient.control_names, *memories))


def with_delays(transient: Transient, delays: Mapping[str, int]) -> Transient:
    """The same run with some controls taken so many samples earlier, as `delay` in a signals file does."""
    u, controls = transient.u.copy(), list(transient.signals.controls) if transient.signals is not None else []
    for name, samples in delays.items():
        if name not in transient.control_names:
            there = ", ".join(transient.control_names)
            raise TransientError(f"{transient.name}: there is no control '{name}'; there are {there}")
        j = list(transient.control_names).index(name)
        if controls and controls[j].memory is not None:
            raise TransientError(f"{transient.name}: control '{name}' is {controls[j].field}; it takes no delay")
        u[:, j] = _column(transient, u[:, j], Memory("lag", samples))
        if controls:
            controls[j] = replace(controls[j], delay=controls[j].delay + samples)
    if transient.signals is not None:
        return transient.replace(u=u, signals=replace(transient.signals, controls=tuple(controls)))
    return transient.replace(u=u)


def recalled(transient: Transient) -> Transient:
    """The same run with its memories taken again from its states and controls, after these were changed."""
    if transient.signals is None or not transient.signals.recalled:
        return transient
    z = np.hstack([transient.x, transient.u, transient.s])
    for r in transient.signals.recalled:
        z[:, r.position] = _column(transient, z[:, r.of], r.memory)
    n, m = transient.x.shape[1], transient.u.shape[1]
    return transient.replace(u=z[:, n : n + m], s=z[:, n + m :])


def memory_of(signal: Signal, memory: Memory, name: str) -> Signal:
    """A memory of a signal, as a control."""
    unit = f"{signal.unit}/s" if signal.unit and memory.kind == "rate" else signal.unit
    steady = signal.steady if memory.kind == "lag" else 0.0
    if signal.delay:
        samples = signal.delay + memory.samples if memory.kind == "lag" else 0
        if not samples:
            raise TransientError(f"'{signal.name}' is delayed, and has no {memory.kind}; take it of the field itself")
        memory = Memory("lag", samples)
    return replace(signal, name=name, field=memory.of(signal.field), steady=steady, unit=unit, delay=0)


def _column(transient: Transient, values: Values, memory: Memory) -> Values:
    opens = np.diff(transient.segment, prepend=-1) != 0
    return recall(values, memory, np.concatenate([[math.nan], transient.dt])[: len(values)], opens)
