# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The turbofan of Leibov (2006): the published uncertain matrices, and transients drawn from them."""

from __future__ import annotations

import json
from importlib.resources import files

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap, TimeSource

STATE_TOPIC = "/engine/state"
CONTROL_TOPIC = "/engine/control"
JOINT_STATE = "sensor_msgs/msg/JointState"

DT_NS = 25_000_000
"""Step of the published model, ns."""
PULSE, REST = 30, 6
"""Steps of one pulse and of the rest after it: the states are still moving when the next pulse comes."""
AMPLITUDE = (0.05, 0.15)
"""Normalised height of a pulse, drawn once per pulse; within it every step is drawn within RIPPLE of that."""
RIPPLE = 0.3
FAULT_SPREAD = 1.25
FAULT_A00 = -1.9263 - 2.0
"""A fault: each element at an end of an interval FAULT_SPREAD times as wide, around a fan that is also more damped."""


def leibov2006() -> UncertainLTI:
    """The model printed in the paper: n = 5, m = 4, normalised quantities, 1/s.

    Its signals name `position[<state>]` of the topics that the plant node publishes.
    """
    data = json.loads((files(__package__) / "leibov2006.json").read_text(encoding="utf-8"))
    states, controls = _signals(data["states"], STATE_TOPIC), _signals(data["controls"], CONTROL_TOPIC)
    time: dict[str, TimeSource] = {STATE_TOPIC: "header", CONTROL_TOPIC: "header"}
    signals = SignalMap(states, controls, clock=STATE_TOPIC, max_gap=2.5 * data["dt"], time=time, source="leibov2006")
    return UncertainLTI(data["A"], data["B"], data["dA"], data["dB"], signals=signals)


def _signals(names: list[str], topic: str) -> tuple[Signal, ...]:
    return tuple(Signal(name, topic, f"position[{name}]", type=JOINT_STATE) for name in names)


def pulses(steps: int, controls: int, rng: np.random.Generator) -> Array:
    """Pulses on each control in turn, first up and then down, separated by short rests; (steps, controls).

    Returns (steps, controls): normalised deviations.
    """
    u = np.zeros((steps, controls))
    for number, start in enumerate(range(REST, steps, PULSE + REST)):
        stop = min(start + PULSE, steps)
        sign = 1.0 if number % 2 == 0 else -1.0
        height = rng.uniform(*AMPLITUDE)
        u[start:stop, number // 2 % controls] = sign * height * rng.uniform(1 - RIPPLE, 1 + RIPPLE, stop - start)
    return u


def transient(steps: int, seed: int, fault_at: int | None = None, start_ns: int = 0) -> Transient:
    """One run of the plant from rest, every matrix element drawn again inside its interval at each step.

    Leibov (2006), eq. (3): x_{k+1} = x_k + Δt (A_k x_k + B_k u_k) with A_k in A ± ΔA and B_k in B ± ΔB.
    """
    model = leibov2006()
    rng = np.random.default_rng(seed)
    u = pulses(steps, model.m, rng)
    nominal, spread = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    faulty = nominal.copy()
    faulty[0, 0] = FAULT_A00
    x = np.zeros((steps, model.n))
    for k in range(steps - 1):
        draw = rng.uniform(-1.0, 1.0, nominal.shape)
        if fault_at is not None and k >= fault_at:
            elements = faulty + FAULT_SPREAD * np.sign(draw) * spread
        else:
            elements = nominal + draw * spread
        x[k + 1] = x[k] + DT_NS * 1e-9 * (elements @ np.concatenate([x[k], u[k]]))
    t_ns, signals = start_ns + DT_NS * np.arange(steps, dtype=np.int64), model.signals
    return Transient(t_ns, x, u, name=f"leibov2006, seed {seed}", signals=signals, max_gap=signals.max_gap)
