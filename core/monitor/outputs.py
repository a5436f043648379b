# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Output topics in one table: name, message type, when each is published, and which number of a verdict it carries.

Publishers of the node, snapshots, annotated recordings, layouts of viewers and the reference take them from `OUTPUTS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

VECTOR_TYPE, FLAG_TYPE, TEXT_TYPE = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool", "std_msgs/msg/String"
NODE = "/envelope_monitor"
"""Name of the node unless it is given another."""


@dataclass(frozen=True)
class Output:
    """One topic below the node's name.

    `name`: last part of the topic's name; `type`: message type: `VECTOR_TYPE` with one number per state, `FLAG_TYPE`
    with the alarm, or `TEXT_TYPE` in words; `when`: for every clock message, for those with a verdict, on a change, or
    for the prediction after an open sample: of one step, or over the longest horizon; `text`: its meaning, for the
    reference (Markdown); `position`: the number of a verdict that `position` holds, one of `verdict.NUMBERS`; empty
    without one; `velocity`: attribute of a verdict, true or false, that `velocity` repeats for each state; empty
    without one; `view`: how viewers draw it: a bound or the sample in the plot of each state, all states in one plot,
    changes in time, or the alarm. Empty: not at all; `title`: title of its plot, for the views "states" and "steps";
    `limits`: constant lines of its plot, for the view "states"; `of`: what its numbers are of: the states, the states
    at one step and at each horizon of the model, or the statistics of the alarm. A model without horizons, or an alarm
    without statistics, does not have the output.
    """

    name: str
    type: str
    when: Literal["message", "judged", "changed", "predicted", "predicted over"]
    text: str
    position: str = ""
    velocity: str = ""
    view: Literal["", "bound", "sample", "states", "steps", "alarm"] = ""
    title: str = ""
    limits: tuple[tuple[str, float], ...] = ()
    of: Literal["states", "horizons", "statistics"] = "states"


FLAGS = Output(
    "flags",
    VECTOR_TYPE,
    "message",
    "for every clock message: `position` 0 contained, 1 violated, NaN no verdict, per state; `velocity` 1: the sample "
    "before lies outside the fitted domain",
    position="flags",
    velocity="outside_domain",
    view="steps",
    title="0 contained, 1 violated",
)
VIOLATION = Output(
    "violation",
    FLAG_TYPE,
    "message",
    "the alarm: m of the last n verdicts violated; false also while nothing is known; every verdict, and at least "
    "every `heartbeat`, with a deadline offered",
    view="alarm",
)
REASON = Output(
    "reason",
    TEXT_TYPE,
    "changed",
    "in words, which rule, state and horizon hold the alarm, or why there is no verdict; when it changes, and once to "
    "whoever subscribes later (transient local)",
)
OUTPUTS = (
    FLAGS,
    VIOLATION,
    Output("lower", VECTOR_TYPE, "judged", "the lower bound that was judged", position="lower", view="bound"),
    Output("upper", VECTOR_TYPE, "judged", "the upper bound that was judged", position="upper", view="bound"),
    Output("state", VECTOR_TYPE, "judged", "the sample that was judged", position="state", view="sample"),
    Output(
        "utilisation",
        VECTOR_TYPE,
        "judged",
        "where between its bounds each state lies, -1 to 1 inside",
        position="utilisation",
        view="states",
        title="utilisation: -1 and 1 at the bounds",
        limits=(("upper bound", 1.0), ("lower bound", -1.0)),
    ),
    Output(
        "horizon_utilisation",
        VECTOR_TYPE,
        "judged",
        "of a model with horizons, the utilisation after one step and after each number of steps; `name` is "
        "`state@steps`, NaN where fewer transitions follow one another",
        position="horizon_utilisation",
        of="horizons",
    ),
    Output(
        "statistics",
        VECTOR_TYPE,
        "judged",
        "of an alarm with statistics, each over its threshold: beyond 1 and -1 it raises the alarm; `name` is "
        "`kind/state`, `kind@steps/state` at a horizon, and `chi2/joint` of all states together",
        position="statistics",
        of="statistics",
    ),
    REASON,
    Output(
        "predicted_lower",
        VECTOR_TYPE,
        "predicted",
        "on receipt of a sample, the lower bound one median step on, with the control known so far; only while "
        "somebody subscribes",
        position="lower",
    ),
    Output("predicted_upper", VECTOR_TYPE, "predicted", "the same for the upper bound", position="upper"),
    Output(
        "horizon_predicted_lower",
        VECTOR_TYPE,
        "predicted over",
        "of a model with horizons, on receipt of a sample, the lower bound as many median steps on as the longest "
        "horizon has, if the controls known so far stay; only while somebody subscribes",
        position="lower",
    ),
    Output("horizon_predicted_upper", VECTOR_TYPE, "predicted over", "the same for the upper bound", position="upper"),
)
"""Every output, those of every clock message first."""

RECORDED = tuple(output for output in OUTPUTS if not output.when.startswith("predicted"))
"""The outputs that files hold: all that depend on verdicts alone."""
JUDGED = tuple(output for output in OUTPUTS if output.when == "judged")
"""The outputs that only a verdict has."""


def names_of(
    states: Sequence[str], steps: Sequence[int] = (), statistics: Sequence[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Names of the numbers that outputs carry, by what they are of."""
    over = [1, *steps] if steps else []
    horizons = tuple(f"{name}@{h}" for h in over for name in states)
    return {"states": tuple(states), "horizons": horizons, "statistics": tuple(statistics)}
