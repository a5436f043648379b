# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Facts of a check as plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.jumps import jump_words, jumps
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.frozen import repeat_words
from uncertain_lti.monitor.likeness import LEAST, over_recording
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports.charts import runs
from uncertain_lti.reports.regimes import check_regimes, sample_blocks, unknown_in_words
from uncertain_lti.sampling.reading import unused
from uncertain_lti.sampling.status import Status
from uncertain_lti.sampling.transient import Transient

UNVOUCHED, STRANGE = 0.2, 0.5
"""Share of the verdicts outside the fitted domain from which on their quiet says nothing; there, or in alarm from early
on, from which the machine may be another."""
JUDGED = 0.5
"""Share of the steps that must have a verdict for their quiet to say something."""
MOST_EXPLAINED = 100
"""Patterns of alarms that are explained."""
OUTCOMES = ("alarm", "unknown", "violations", "quiet")
"""What a check can come to, from what weighs most."""


def check_data(model: UncertainLTI, verdicts: Verdicts, samples: bool = True) -> dict[str, Any]:
    """Result of a check as plain data.

    Counts, the first and the longest violation of each state, the spans in which the alarm was raised, widths and
    coverage; with samples, a verdict per sample in recorded units (`flags`: 0 contained, 1 violated, null no
    verdict). Of a model with horizons also `horizons`, the windows of each with those outside and the first per state,
    and of each sample its `horizon_utilisation`, a row per number of steps. Of a scheduled model also `regimes`, what
    became of the verdicts in each, `unknown`, in words why a regime is unknown or a mode has no verdict, and of each
    sample its `regime`, a position in `regimes`. `frozen` and `repeats` have the exact repeats that raised the alarm,
    and others longer than any of the fit, each from its last fresh sample. `explained` says of alarms what they look
    like.
    """
    transient = verdicts.transient
    t = transient.t_ns
    judged = int(verdicts.judged.sum())
    odd = [(int(verdicts.unfitted_step.sum()), Status.STEP), (int(verdicts.unlisted_mode.sum()), Status.MODE)]
    odd.append((int((verdicts.withheld.any(axis=1) & ~verdicts.judged).sum()), Status.FROZEN))
    partly = int((verdicts.withheld.any(axis=1) & verdicts.judged).sum())
    if verdicts.asked is not None:
        odd.append((int((~verdicts.asked).sum()), Status.UNASKED))
    width = np.where(verdicts.judged[:, None], verdicts.upper - verdicts.lower, np.nan)
    states = {}
    before = np.concatenate([np.full((1, model.n), np.nan), transient.x[:-1]])
    change, largest = jumps(model, before, transient.x)
    for i, name in enumerate(model.state_names):
        bad, own = verdicts.flags[:, i] == 1.0, int((~np.isnan(verdicts.flags[:, i])).sum())
        violated = runs(bad)
        longest = max(violated, key=lambda run: (run[1] - run[0], -run[0]), default=None)
        states[name] = {
            "violations": int(bad.sum()),
            "verdicts": own,
            "inside": None if not own else 1.0 - int(bad.sum()) / own,
            "first_violation": _instant(transient, violated[0][0]) if violated else None,
            "longest_violation": None
            if longest is None
            else {**_instant(transient, longest[0]), "samples": longest[1] - longest[0], **_length(t, longest)},
            "mean_width": float(np.nanmean(width[:, i])) if own else None,
            "max_width": float(np.nanmax(width[:, i])) if own else None,
            "unit": model.signals.states[i].unit,
            "jump": _jump(model, verdicts, i, change[:, i], float(largest[i])),
        }
    alarms = runs(verdicts.alarm)
    data: dict[str, Any] = {
        "recording": transient.name,
        "samples": len(transient),
        "verdicts": judged,
        "no_verdict": [
            *unused(transient),
            *(f"{count} {kind.value}" for count, kind in odd if count),
            *([f"{partly} frozen in part"] if partly else []),
        ],
        "violated": int(verdicts.violated.sum()),
        "inside": None if not judged else 1.0 - int(verdicts.violated.sum()) / judged,
        "outside_domain": int(verdicts.outside_domain.sum()),
        "unknown_regime": int(verdicts.unknown_regime.sum()),
        "unknown": unknown_in_words(model, verdicts),
        "regimes": check_regimes(model, verdicts),
        "states": states,
        "horizons": _horizons(model, verdicts),
        "alarm": bool(alarms),
        "alarms": [
            {**_instant(transient, start), **_length(t, (start, stop)), "raised": _raised(verdicts, start)}
            for start, stop in alarms
        ],
        "frozen": _repeats(model, verdicts, verdicts.frozen),
        "repeats": _repeats(model, verdicts, verdicts.repeating & ~_before(verdicts.frozen, verdicts.repeating)),
    }
    data["explained"] = _explained(model, verdicts)
    share = data["outside_domain"] / judged if judged else 1.0
    reason = _why_unknown(model, verdicts, data)
    unknown = bool(reason)
    data["outside_domain_share"] = share if judged else None
    data["outcome"] = OUTCOMES[0 if alarms else 1 if unknown else 2 if data["violated"] else 3]
    data["reason"] = reason
    if samples:
        block, table = sample_blocks(model, verdicts), verdicts.horizon_utilisation
        data["verdict_per_sample"] = [
            {
                "t_ns": int(t[k]),
                "status": status.value,
                "flags": _list(verdicts.flags[k]),
                "lower": _list(verdicts.lower[k]),
                "upper": _list(verdicts.upper[k]),
                "state": _list(transient.x[k]),
                "utilisation": _list(verdicts.utilisation[k]),
            }
            | ({"horizon_utilisation": [_list(row) for row in table[k]]} if model.horizons else {})
            | {
                "outside_domain": bool(verdicts.outside_domain[k]),
                "alarm": bool(verdicts.alarm[k]),
            }
            | (
                {"regime": int(block[k]) if block[k] >= 0 else None, "unknown_regime": bool(verdicts.unknown_regime[k])}
                if model.schedule is not None
                else {}
            )
            for k, status in enumerate(verdicts.statuses())
        ]
    return data


def _why_unknown(model: UncertainLTI, verdicts: Verdicts, data: dict[str, Any]) -> str:
    """Why a check says nothing of the machine; empty if it does."""
    judged, steps = data["verdicts"], max(data["samples"] - 1, 1)
    if verdicts.asked is not None:
        steps = max(int(verdicts.asked.sum()) - 1, 1)
    if not judged:
        return "; ".join(["no verdict was possible, so nothing is known", *data["unknown"]])
    if judged < JUDGED * steps:
        why = f" ({', '.join(data['no_verdict'])})" if data["no_verdict"] else ""
        return f"only {judged} of {steps} steps could be judged{why}"
    share = data["outside_domain"] / judged
    if share > UNVOUCHED:
        ask = "is this the same machine, in the same units? " if share > STRANGE else ""
        return (
            f"{share:.2%} of the verdicts are outside the fitted domain, where nothing vouches for the bounds; {ask}"
            f"fit recordings that reach as far" + f" ({'; '.join(data['unknown'])})" * bool(data["unknown"])
        )
    alarm = model.fit_summary.get("alarm")
    if isinstance(alarm, dict) and alarm.get("worth") == "none":
        return f"the model is {alarm['headline']}"
    x, span = verdicts.transient.x[verdicts.judged], model.domain.x_max - model.domain.x_min
    if (span > 0).any() and not np.ptp(x, axis=0).any():
        return "nothing that is judged moves in it"
    alarmed = verdicts.alarm[verdicts.judged]
    if alarmed.mean() > STRANGE and alarmed[: max(1, judged // 10)].any():
        return (
            f"the alarm is up for {alarmed.mean():.0%} of it, from early on: the fault was there before, or this is "
            f"another machine, in other units, or run as in no recording of the fit"
        )
    return ""


def _explained(model: UncertainLTI, verdicts: Verdicts) -> list[dict[str, Any]]:
    """What the alarms look like, those close to one another together; the first `MOST_EXPLAINED`."""
    found: list[dict[str, Any]] = []
    if not verdicts.alarm.any():
        return found
    table = verdicts.horizon_utilisation
    for start, stop, explainer in over_recording(
        model, verdicts.judged, verdicts.alarm, table, verdicts.lower, verdicts.upper, verdicts.outside_domain
    ):
        like = explainer.likeness()
        if like is None or like.verdicts < LEAST:
            continue
        found.append(
            {
                **_instant(verdicts.transient, start),
                **_length(verdicts.transient.t_ns, (start, stop + 1)),
                "label": like.label or None,
                "matches": dict(like.matches),
                "parts": [part._asdict() for part in like.parts],
                "first": list(like.first),
                "verdicts": like.verdicts,
                "text": like.words,
            }
        )
        if len(found) == MOST_EXPLAINED:
            break
    return found


def _repeats(model: UncertainLTI, verdicts: Verdicts, which: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """The repeats that some samples (N+1, n) belong to, in order of time."""
    if model.repeats is None or not which.any():
        return []
    transient, found = verdicts.transient, []
    for i, name in enumerate(model.state_names):
        fresh = np.concatenate([[True], (np.diff(transient.x[:, i]) != 0) | (np.diff(transient.segment) > 0)])
        begins = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
        for start, stop in runs(which[:, i]):
            begin = int(begins[start])
            seconds, told = (float(transient.t_ns[k] - transient.t_ns[begin]) * 1e-9 for k in (stop - 1, start))
            longest = float(model.repeats.longest_repeat_s[i])
            found.append(
                {
                    "state": name,
                    **_instant(transient, begin),
                    "seconds": seconds,
                    "told_after": told,
                    "longest_in_fit": longest,
                    "why": verdicts.why_frozen.get((start, i), ""),
                    "text": f"{name} {repeat_words(seconds, longest)} from {transient.t[begin]:.4f} s",
                }
            )
    return sorted(found, key=lambda repeat: (repeat["k"], repeat["state"]))


def _before(frozen: NDArray[np.bool_], longer: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Samples of `longer` whose repeat goes on to be frozen, which is told already."""
    found = np.zeros_like(longer)
    for i in range(longer.shape[1]):
        for start, stop in runs(longer[:, i]):
            found[start:stop, i] = stop < len(frozen) and frozen[stop, i]
    return found


def _horizons(model: UncertainLTI, verdicts: Verdicts) -> list[dict[str, Any]]:
    """What became of the windows of each horizon; nothing without horizons."""
    found = []
    for j, horizon in enumerate(model.horizons, 1):
        table = verdicts.horizon_utilisation[:, j]
        there = ~np.isnan(table).all(axis=1)
        with np.errstate(invalid="ignore"):
            left = np.abs(table) > 1.0
        first = [np.flatnonzero(left[:, i]) for i in range(model.n)]
        count = int(there.sum())
        found.append(
            {
                "steps": horizon.steps,
                "windows": count,
                "outside": int(left.any(axis=1).sum()),
                "inside": None if not count else 1.0 - int(left.any(axis=1).sum()) / count,
                "states": {
                    name: {
                        "outside": len(rows),
                        "first": _instant(verdicts.transient, int(rows[0])) if len(rows) else None,
                    }
                    for name, rows in zip(model.state_names, first, strict=True)
                },
            }
        )
    return found


def outcome(recordings: Sequence[dict[str, Any]]) -> str:
    """The outcome of several recordings: the first of OUTCOMES that one of them has."""
    return next(o for o in OUTCOMES if o == OUTCOMES[-1] or any(r["outcome"] == o for r in recordings))


def _jump(model: UncertainLTI, verdicts: Verdicts, i: int, change: Array, largest: float) -> dict[str, Any] | None:
    """The largest jump with which a state left its bounds, if it is larger than any of the fit."""
    size = np.where(verdicts.flags[:, i] == 1.0, np.abs(change), 0.0)
    k = int(np.nanargmax(size)) if len(size) else 0
    if not len(size) or not size[k] > 0.0:
        return None
    text = jump_words(model.state_names[i], float(change[k]), largest)
    return {**_instant(verdicts.transient, k), "change": float(change[k]), "largest_in_fit": largest, "text": text}


def _raised(verdicts: Verdicts, k: int) -> list[dict[str, Any]]:
    """Which rules, states and horizons raised the alarm at a sample."""
    return [
        {"rule": r.label, "state": r.state, "horizon": r.horizon, "value": r.value, "words": r.words}
        for r in verdicts.raised(k)
    ]


def _instant(transient: Transient, k: int) -> dict[str, Any]:
    """Sample k: its time since the first sample, s, and its stamp, ns."""
    return {"k": k, "t": float(transient.t[k]), "t_ns": int(transient.t_ns[k])}


def _length(t_ns: NDArray[np.int64], run: tuple[int, int]) -> dict[str, float]:
    """From the first to the last sample of a run, s."""
    return {"seconds": float(t_ns[run[1] - 1] - t_ns[run[0]]) * 1e-9}


def _list(row: Array) -> list[float | None]:
    return [v if math.isfinite(v) else None for v in row.tolist()]
