# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Findings: whether a model may be relied on and what happened in recordings, as plain data with the reasons."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti import __version__
from uncertain_lti.base.english import plural, times
from uncertain_lti.base.files import sha256
from uncertain_lti.model.alarm_rule import AlarmRule, with_containment
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports.check_data import check_data
from uncertain_lti.reports.detectable_text import detectable_data
from uncertain_lti.reports.regimes import block_facts, blocks_in_words
from uncertain_lti.reports.reliance import WEIGHTS, answer, reasons
from uncertain_lti.reports.tables import finite_data, list_of, number, numbers_of, shortened
from uncertain_lti.reports.validation_text import rule_text

APART = 10
"""Verdicts without a violation that end an episode."""


MOST_EPISODES = 1000


def findings(
    model: UncertainLTI,
    model_file: str | os.PathLike[str],
    checked: Sequence[Verdicts],
    rule: AlarmRule | None = None,
    conditions: str = "",
) -> dict[str, Any]:
    """Facts about a model and about recordings that were checked against it.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    model_file : path
        Where it came from, or its name.
    checked : sequence of Verdicts
        One per recording, of `EnvelopeMonitor.check`.
    rule : AlarmRule, optional
        The alarm rule of the check; default the model's.
    conditions : str, default ""
        What else the alarm depended on, in words.

    Returns
    -------
    dict
        `rely`: an answer (yes, with care, unknown, no) and its reasons, each with how much it weighs; `happened`: a
        sentence per recording; `model`, `validation` and `recordings` what they rest on. `recordings` holds what
        `check --json` says, the files with their checksums, and episodes of violations.

    Raises
    ------
    OSError
        A file of a recording cannot be read.
    """
    rule = rule or model.alarm_rule
    rules = model.alarm if rule == model.alarm_rule else with_containment(model.alarm, rule)
    recordings = [_recording(model, verdicts) for verdicts in checked]
    validation = _validation(model)
    for_and_against = reasons(model, validation, recordings)
    facts: dict[str, Any] = {
        "version": __version__,
        "rely": {"answer": answer(for_and_against), "reasons": for_and_against},
        "happened": [_happened(r) for r in recordings],
        "alarm": any(r["alarm"] for r in recordings),
        "rule": {
            "words": "; or ".join(one.words for one in rules),
            "violations": rule.violations,
            "window": rule.window,
            "margin": rule.margin,
            "conditions": conditions,
        },
        "model": _model(model, model_file),
        "validation": validation,
        "recordings": recordings,
    }
    finite: dict[str, Any] = finite_data(facts)
    return finite


def _model(model: UncertainLTI, model_file: str | os.PathLike[str]) -> dict[str, Any]:
    fit = model.fit_summary
    known = {
        key: fit[key]
        for key in (
            "criterion",
            "additive",
            "transitions",
            "transients",
            "violations",
            "objective",
            "optimality_gap",
            "rank",
        )
        if isinstance(fit.get(key), (str, int, float))
    }
    width = numbers_of(fit.get("mean_width_recorded"), model.n), numbers_of(fit.get("max_width_recorded"), model.n)
    return {
        "file": os.fspath(model_file),
        "sha256": sha256(model_file) if os.path.isfile(model_file) else None,
        "fit": known,
        "messages": [str(m) for m in list_of(fit.get("messages"))],
        "sources": [
            {"file": str(s.get("file", "")), "sha256": str(s.get("sha256", ""))}
            for s in list_of(fit.get("sources"))
            if isinstance(s, Mapping)
        ],
        "states": [
            {
                "name": s.name,
                "unit": s.unit,
                "topic": s.topic,
                "field": s.field,
                "steady": s.steady,
                "scale": s.scale,
                "mean_width": width[0][i] if width[0] else None,
                "max_width": width[1][i] if width[1] else None,
            }
            for i, s in enumerate(model.signals.states)
        ],
        "controls": [
            {"name": s.name, "unit": s.unit, "topic": s.topic, "field": s.field} for s in model.signals.controls
        ],
        "clock": model.sampling.clock,
        "dt_median": model.sampling.dt_median,
        "scheduling": [
            {"name": s.name, "unit": s.unit, "topic": s.topic, "field": s.field} for s in model.signals.scheduling
        ],
        "eigenvalues": [[float(v.real), float(v.imag)] for v in model.eigenvalues()] if model.schedule is None else [],
        "schedule": "" if model.schedule is None else model.schedule.words,
        "regimes": block_facts(model),
        "regimes_in_words": blocks_in_words(model),
    }


def _validation(model: UncertainLTI) -> dict[str, Any] | None:
    """The model's section on validation where it says what `validate` writes; another one counts as none."""
    data = model.validation
    try:
        return {
            "kind": "transients" if data["kind"] == "transients" else "blocks",
            **{key: int(data[key]) for key in ("parts", "verdicts", "parts_inside")},
            "hours": _real(data["hours"]),
            "inside": None if data["inside"] is None else _real(data["inside"]),
            "inside_interval": [_real(data["inside_interval"][0]), _real(data["inside_interval"][1])],
            "confidence": _real(data["confidence"]),
            "false_alarms": [
                {
                    "rule": rule_text(alarm),
                    "alarms": int(alarm["alarms"]),
                    "per_hour": _real(alarm["per_hour"]),
                    "interval": [None if v is None else _real(v) for v in (alarm["interval"][0], alarm["interval"][1])],
                }
                for alarm in data["false_alarms"]
            ],
            "states": {name: _left_out(data["states"][name]) for name in model.state_names},
            "words": str(data["scenario"]["words"]),
            "what": "group" if data.get("groups") else "recording" if data["kind"] == "transients" else "block",
            "condition": str(data.get("condition", "")),
            "condition_short": str(data.get("condition_short", "")),
            "hint": str(data.get("hint", "")),
            "notes": [str(note) for note in data["notes"]],
            "detectable": detectable_data(data),
        }
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        return None


def _left_out(state: Mapping[str, Any]) -> dict[str, Any]:
    optional = ("inside", "mean_width_left_out", "mean_width_full")
    kept: dict[str, Any] = {key: None if state[key] is None else _real(state[key]) for key in optional}
    return {**kept, "parts_inside": int(state["parts_inside"])}


def _real(value: Any) -> float:
    """A finite number; raises TypeError or ValueError for anything else."""
    if isinstance(value, str) or not math.isfinite(value):
        raise ValueError
    return float(value)


def _recording(model: UncertainLTI, verdicts: Verdicts) -> dict[str, Any]:
    transient = verdicts.transient
    data = check_data(model, verdicts, samples=False)
    x = np.where(np.isfinite(transient.x), transient.x, np.nan)
    for i, name in enumerate(model.state_names):
        there = x[~np.isnan(x[:, i]), i]
        span = float(np.ptp(there)) if len(there) else None
        state = data["states"][name]
        state["range"] = span
        state["width_to_range"] = state["mean_width"] / span if span and state["mean_width"] is not None else None
        state["worst"] = _worst(verdicts, i, np.flatnonzero(verdicts.flags[:, i] == 1.0))
    episodes, count = _episodes(model, verdicts)
    return {
        **data,
        "files": [{"file": path, "sha256": sha256(path)} for path in transient.sources],
        "seconds": float(np.abs(np.diff(transient.t_ns)).sum()) * 1e-9,
        "episodes": episodes,
        "episode_count": count,
        "notes": list(transient.notes),
    }


def _episodes(model: UncertainLTI, verdicts: Verdicts) -> tuple[list[dict[str, Any]], int]:
    """Violations that fewer than `APART` verdicts lie between; the first `MOST_EPISODES`, and how many there are."""
    rows = np.flatnonzero(verdicts.violated)
    if not len(rows):
        return [], 0
    order = np.cumsum(verdicts.judged)[rows]
    pass_ = np.concatenate([[0], np.cumsum(np.diff(verdicts.transient.t_ns) < 0)])[rows]
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(order) > APART) | (np.diff(pass_) > 0)]))
    ends = np.append(begins[1:], len(rows))
    t, t_ns = verdicts.transient.t, verdicts.transient.t_ns
    found = []
    for a, b in list(zip(begins, ends, strict=True))[:MOST_EPISODES]:
        inside = rows[a:b]
        states = {}
        for i, name in enumerate(model.state_names):
            bad = inside[verdicts.flags[inside, i] == 1.0]
            if len(bad):
                states[name] = {"violations": len(bad), "first": float(t[bad[0]]), **_worst(verdicts, i, bad)}
        first, last = int(inside[0]), int(inside[-1])
        found.append(
            {
                "first": {"k": first, "t": float(t[first]), "t_ns": int(t_ns[first])},
                "last": {"k": last, "t": float(t[last]), "t_ns": int(t_ns[last])},
                "verdicts_violated": len(inside),
                "alarm": bool(verdicts.alarm[first : last + 1].any()),
                "states": states,
            }
        )
    return found, len(begins)


def _worst(verdicts: Verdicts, state: int, rows: NDArray[np.intp]) -> dict[str, Any]:
    """Utilisation farthest from 0 among these samples (None where the bounds have no width), and when."""
    if not len(rows):
        return {"utilisation": None, "t": None}
    utilisation = verdicts.utilisation[rows, state]
    k = int(rows[np.argmax(np.abs(utilisation))])
    value = float(verdicts.utilisation[k, state])
    return {"utilisation": value if math.isfinite(value) else None, "t": float(verdicts.transient.t[k])}


def _happened(recording: Mapping[str, Any]) -> dict[str, Any]:
    """One sentence, and whether there is something to look at."""
    found = _violated(recording)
    if not recording["frozen"]:
        return found
    first = "frozen: {text}, {why}".format_map(recording["frozen"][0])
    more = len(recording["frozen"]) - 1
    return {**found, "state": "alarm", "text": f"{first}{f', and {more} more' * bool(more)}. {found['text']}"}


def _violated(recording: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of its verdicts."""
    judged, bad = recording["verdicts"], recording["violated"]
    if not judged:
        return {"recording": recording["recording"], "state": "unknown", "text": "no verdict was possible"}
    over = f"{plural(judged, 'verdict')} over {number(recording['seconds'])} s"
    unknown = recording["outcome"] == "unknown"
    but = f", but {recording['reason']}" if unknown else ""
    if not bad:
        state = "unknown" if unknown else "quiet"
        return {
            "recording": recording["recording"],
            "state": state,
            "text": f"{over}: every one inside all bounds{but}",
        }
    states = {name: s["violations"] for name, s in recording["states"].items() if s["violations"]}
    most = sorted(states, key=lambda name: -states[name])[:3]
    text = f"{over}: {bad} violated, {_episodes_word(recording['episode_count'])}, first at "
    listed = ", ".join(f"{shortened(name)} ({states[name]})" for name in most)
    text += f"{recording['episodes'][0]['first']['t']:.8g} s; most often {listed}"
    if recording["alarm"]:
        first = recording["alarms"][0]
        text += f". The alarm was raised {times(len(recording['alarms']))}, first at {first['t']:.8g} s"
        return {"recording": recording["recording"], "state": "alarm", "text": text}
    state = "unknown" if unknown else "violations"
    return {"recording": recording["recording"], "state": state, "text": f"{text}. The alarm was not raised{but}"}


def _episodes_word(count: int) -> str:
    return "in one episode" if count == 1 else f"in {count} episodes"


def findings_text(facts: Mapping[str, Any]) -> str:
    """What `report` prints of `findings`."""
    lines = [f"may I rely on it? {facts['rely']['answer']}"]
    reasons = sorted(facts["rely"]["reasons"], key=lambda r: WEIGHTS.index(r["weight"]))
    lines += [f"  {r['weight']}: {r['text']}" for r in reasons]
    lines.append("what happened?")
    lines += [f"  {h['recording']}: {h['text']}" for h in facts["happened"]]
    return "\n".join(lines)
