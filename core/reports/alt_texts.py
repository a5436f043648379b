# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a figure shows, in words for those who do not see it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.english import plural, shortlist, times
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.drawing import elements
from uncertain_lti.reports.tables import beyond, number, shortened

_MOST = 6


def envelope_text(recording: Mapping[str, Any], states: Sequence[str]) -> str:
    """What is seen of a recording between its bounds."""
    if not recording["verdicts"]:
        return "No sample has a verdict."
    bad = sorted((s for s in states if recording["states"][s]["violations"]), key=_violations(recording))
    left = [s for s in states if not recording["states"][s]["violations"]]
    parts = [f"{plural(len(states), 'state')} over {number(recording['seconds'])} s."]
    if bad:
        parts.append(f"Outside its bounds: {shortlist([_outside(recording, name) for name in bad], _MOST)}.")
    if left:
        inside = "every state drawn" if not bad else shortlist([shortened(name) for name in left], _MOST)
        parts.append(f"Always inside: {inside}.")
    alarms = recording["alarms"]
    if alarms:
        parts.append(f"The alarm is raised {times(len(alarms))}, first at {alarms[0]['t']:.8g} s.")
    return " ".join(parts)


def _violations(recording: Mapping[str, Any]) -> Any:
    return lambda name: -recording["states"][name]["violations"]


def _outside(recording: Mapping[str, Any], name: str) -> str:
    violations, episodes = recording["states"][name]["violations"], recording["episodes"]
    first = next((e["states"][name]["first"] for e in episodes if name in e["states"]), None)
    since = "" if first is None else f" from {first:.8g} s"
    return f"{shortened(name)} {times(violations)}{since}"


def episode_text(episode: Mapping[str, Any]) -> str:
    """An episode in a phrase."""
    first, last = episode["first"]["t"], episode["last"]["t"]
    when = f"at {first:.8g} s" if first == last else f"from {first:.8g} s to {last:.8g} s"
    count = plural(episode["verdicts_violated"], "verdict")
    return f"{when}, {count} violated, {'with' if episode['alarm'] else 'without'} an alarm"


def beginning_text(episode: Mapping[str, Any]) -> str:
    """Which states leave their bounds first in an episode."""
    first = [shortened(name) for name, state in episode["states"].items() if state["first"] == episode["first"]["t"]]
    return f"Outside its bounds first: {shortlist(first, _MOST)}."


def utilisation_text(recording: Mapping[str, Any], states: Sequence[str]) -> str:
    """What is seen of the utilisation of a recording."""
    bad = sorted((s for s in states if recording["states"][s]["violations"]), key=_violations(recording))
    if not bad:
        return "Every state stays between -1 and 1." if recording["verdicts"] else "No sample has a verdict."
    worst = []
    for name in bad:
        value = recording["states"][name]["worst"]["utilisation"]
        worst.append(f"{shortened(name)} {'without width' if value is None else beyond(value)}")
    return f"Farthest outside: {shortlist(worst, _MOST)}."


def coverage_text(recordings: Sequence[Mapping[str, Any]]) -> str:
    """What is seen of the violated shares of recordings."""
    judged = [r for r in recordings if r["verdicts"]]
    bad = sorted((r for r in judged if r["violated"]), key=lambda r: -r["violated"] / r["verdicts"])
    if not bad:
        return "No verdict is violated." if judged else "No sample has a verdict."
    names = [f"{shortened(r['recording'].rsplit('/')[-1])} {r['violated'] / r['verdicts']:.3g}" for r in bad]
    text = f"Violated share of the verdicts: {shortlist(names, _MOST)}."
    rest = len(judged) - len(bad)
    return text + (f" Without a violation: {plural(rest, 'recording')}." if rest else "")


def budget_text(model: UncertainLTI, shares: Any, columns: Sequence[str]) -> str:
    """What is seen of the widths' budget.

    `shares` (n, columns): of `width_budget`.
    """
    most = [
        f"{shortened(name)} {row.max():.0%} from {shortened(columns[int(row.argmax())])}"
        for name, row in zip(model.state_names, shares, strict=True)
        if row.max(initial=0.0) > 0
    ]
    return f"Largest share of the width: {shortlist(most, _MOST)}." if most else "No bound has a width."


def matrices_text(model: UncertainLTI) -> str:
    """What is seen of the matrices of a model without a schedule."""
    nominal, half, columns = elements(model)
    nominal, half = (values[:, : model.n + model.m] for values in (nominal, half))
    parts = []
    for words, values in (("element", nominal), ("half-width", half)):
        i, j = np.unravel_index(int(np.abs(values).argmax()), values.shape)
        into, out_of = shortened(model.state_names[int(i)]), columns[int(j)].replace("\\$", "$")
        parts.append(f"largest {words} {values[i, j]:.3g} 1/s, of {into} from {out_of}")
    text = "; ".join(parts)
    doubtful = int((half > np.abs(nominal)).sum())
    return f"{text[0].upper()}{text[1:]}. {doubtful} of {half.size} half-widths are greater than their elements."
