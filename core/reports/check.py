# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Facts of a check as plain data, and as blocks of text."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array, Index, Mask, runs
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import Table, beyond, lasting, named, number, plural, share, shortlist, text_of, times
from uncertain_lti.model.domain import STRANGE, jump_words, jumps, outside_in_words, vouched
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.repeats import far_longer, repeat_words
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Raised, back_and_restarts
from uncertain_lti.monitor.likeness import LEAST, over_recording
from uncertain_lti.monitor.reason import why_not
from uncertain_lti.monitor.verdict import NUMBERS, Verdicts
from uncertain_lti.recordings.recording import DATED_NS
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.reading import unused
from uncertain_lti.sampling.transient import Transient, Transitions

JUDGED = 0.5
"""Share of the steps that must have a verdict for their quiet to say something."""
MOVES = 0.1
"""Share of its range in the recording from which on a signal moved while a state repeated; of that in the fit, from
which on a state moves in a recording."""
APART = 10
"""Verdicts without a violation that end an episode."""
MOST_EPISODES, MOST_EXPLAINED = 1000, 100
"""Episodes, and patterns of alarms, in the data."""
_TOGETHER = 1000  # samples whose verdicts are made into plain data at once
MOST_SHOWN = 5
"""Frozen repeats, patterns and rules that the text names."""
_REMEDIES = {
    Status.FIRST: "a verdict needs two samples: check a longer recording",
    Status.GAP: "every step is longer than max_gap: is a topic slower than in the fit? see `uncertain-lti topics`",
    Status.RESET: "time steps back: name the runs in it as recordings of their own",
    Status.MISSING: "a signal is missing, stale or not finite: record it, or fit without it; of topics that are there "
    "compare `uncertain-lti topics` with max_hold and max_skew in the signals file",
    Status.STEP: "is its time in another unit? check one at the rate of the fit, or fit recordings at this rate",
    Status.MODE: "fit recordings of this mode too",
    Status.FROZEN: "states repeat exactly: see whether their sensors and drivers still send",
    Status.UNASKED: "ask for a longer time with --from and --to",
}
"""What to do where no verdict was possible, by the reason that most samples have."""
OUTCOMES = ("alarm", "unknown", "violations", "quiet")
"""What a check can come to, from what weighs most."""


def check_data(model: UncertainLTI, verdicts: Verdicts, samples: bool = True) -> dict[str, Any]:
    """Result of a check as plain data.

    Counts and widths per state, the spans of alarm with what raised them, episodes of violations, exact repeats
    (`frozen` raised the alarm, `repeats` are longer than any of the fit), what alarms look like (`explained`); of a
    scheduled model what became of each regime and why one is unknown, of a model with horizons the windows of each.
    With samples, a verdict per sample in recorded units (`flags`: 0 contained, 1 violated, null no verdict).
    """
    transient, judged = verdicts.transient, int(verdicts.judged.sum())
    violated, outside = int(verdicts.violated.sum()), int(verdicts.outside_domain.sum())
    data: dict[str, Any] = {
        "recording": transient.name,
        "t_ns": int(transient.t_ns[0]),
        "samples": len(transient),
        "seconds": _span(transient, 0, len(transient))["seconds"],
        "verdicts": judged,
        "no_verdict": _not_judged(verdicts),
        "violated": violated,
        "inside": _inside(violated, judged),
        "outside_domain": outside,
        "outside_domain_share": outside / judged if judged else None,
        "beyond": _beyond(model, verdicts),
        "unknown_regime": int(verdicts.unknown_regime.sum()),
        "unknown": unknown_in_words(model, verdicts),
        "regimes": check_regimes(model, verdicts),
        "states": _states(model, verdicts),
        "horizons": _horizons(model, verdicts),
        "alarm": bool(verdicts.alarm.any()),
        "alarms": [
            {
                **_span(transient, start, stop),
                "raised": [_raised(r) for r in verdicts.raised(start)],
                "frozen": [name for name, held in zip(model.state_names, verdicts.frozen[start], strict=True) if held],
            }
            for start, stop in runs(verdicts.alarm)
        ],
        "farthest": _farthest(verdicts),
        "episodes": [_episode(model, verdicts, rows) for rows in islice(_episodes(verdicts), MOST_EPISODES)],
        "episode_count": sum(1 for _ in _episodes(verdicts)),
        "frozen": _repeats(model, verdicts, verdicts.frozen),
        "repeats": _repeats(model, verdicts, verdicts.repeating),
        "explained": list(islice(_explained(model, verdicts), MOST_EXPLAINED)),
        "notes": list(transient.notes),
        "jitter": _jitter(model, verdicts) if verdicts.alarm.any() else [],
    }
    data["reason"] = _why_unknown(model, verdicts, data)
    data["outcome"] = OUTCOMES[[data["alarm"], bool(data["reason"]), bool(violated), True].index(True)]
    if samples:
        data["verdict_per_sample"] = PerSample(model, verdicts)
    return data


def _jitter(model: UncertainLTI, verdicts: Verdicts) -> list[str]:
    """What a fit to this recording would say of its stamps."""
    from uncertain_lti.identification.assembly import assemble
    from uncertain_lti.identification.diagnosis import jittering, uneven_steps

    dt = verdicts.transient.transitions().dt
    if not len(dt) or not uneven_steps(dt).any():
        return []
    with suppress(FitError):
        problem = assemble([verdicts.transient], model.operating_point, None, "none")
        return jittering(model, problem, [*model.state_names, *model.control_names])
    return []


def _farthest(verdicts: Verdicts) -> dict[str, Any] | None:
    """Where the alarm's statistics came nearest to their thresholds, or farthest beyond; None where it has none."""
    found = verdicts.alarms.farthest(verdicts.statistics) if verdicts.statistic_names else None
    return found and {**_instant(verdicts.transient, found[0]), **_raised(found[1]), "what": found[1].what}


def _raised(r: Raised) -> dict[str, Any]:
    return {"rule": r.label, "state": r.state, "horizon": r.horizon, "value": r.value, "words": r.words}


def outcome(recordings: Sequence[dict[str, Any]]) -> str:
    """The outcome of several recordings: the first of OUTCOMES that one of them has."""
    return min((r["outcome"] for r in recordings), key=OUTCOMES.index, default=OUTCOMES[-1])


def _not_judged(verdicts: Verdicts) -> list[str]:
    withheld = verdicts.withheld.any(axis=1)
    counts = {
        Status.STEP.value: verdicts.unfitted_step,
        Status.MODE.value: verdicts.unlisted_mode,
        Status.FROZEN.value: withheld & ~verdicts.judged,
        Status.UNASKED.value: ~verdicts.asked,
        "frozen in part": withheld & verdicts.judged,
    }
    return [*unused(verdicts.transient), *(f"{int(n.sum())} {word}" for word, n in counts.items() if n.any())]


def _states(model: UncertainLTI, verdicts: Verdicts) -> dict[str, dict[str, Any]]:
    x = verdicts.transient.x
    change, largest = jumps(model, np.concatenate([np.full((1, model.n), np.nan), x[:-1]]), x)
    states = {}
    for i, name in enumerate(model.state_names):
        flags = verdicts.flags[:, i]
        there, bad = np.flatnonzero(~np.isnan(flags)), np.flatnonzero(flags == 1.0)
        own, width = len(there), (verdicts.upper[:, i] - verdicts.lower[:, i])[verdicts.judged]
        mean = float(np.nanmean(width)) if own else None
        values = x[np.isfinite(x[:, i]), i]
        span = float(np.ptp(values)) if len(values) else None
        states[name] = {
            "violations": len(bad),
            "verdicts": own,
            "inside": _inside(len(bad), own),
            "first_violation": _instant(verdicts.transient, int(bad[0])) if len(bad) else None,
            "mean_width": mean,
            "range": span,
            "width_to_range": mean / span if span and mean is not None else None,
            "worst": _worst(verdicts, i, bad),
            "largest": abs(_worst(verdicts, i, there)["utilisation"] or 0.0),
            "unit": model.signals.states[i].unit,
            "jump": _jump(verdicts, name, bad, change[:, i], float(largest[i])),
        }
    return states


def _worst(verdicts: Verdicts, state: int, rows: Index) -> dict[str, Any]:
    """Utilisation farthest from 0 among these samples (None where the bounds have no width), and when."""
    if not len(rows):
        return {"utilisation": None, "t": None}
    k = int(rows[np.argmax(np.abs(verdicts.utilisation[rows, state]))])
    value = float(verdicts.utilisation[k, state])
    return {"utilisation": value if math.isfinite(value) else None, "t": _instant(verdicts.transient, k)["t"]}


def _jump(verdicts: Verdicts, name: str, bad: Index, change: Array, largest: float) -> dict[str, Any] | None:
    """The largest jump with which a state left its bounds, if it is larger than any of the fit."""
    size = np.nan_to_num(np.abs(change[bad]))
    if not size.any():
        return None
    k = int(bad[np.argmax(size)])
    text = jump_words(name, float(change[k]), largest)
    return {**_instant(verdicts.transient, k), "change": float(change[k]), "largest_in_fit": largest, "text": text}


def _horizons(model: UncertainLTI, verdicts: Verdicts) -> list[dict[str, Any]]:
    """What became of the windows of each horizon."""
    found = []
    for j, steps in enumerate(model.steps):
        table, states = verdicts.longer_utilisation[:, j], {}
        with np.errstate(invalid="ignore"):
            left = np.abs(table) > 1.0
        for name, rows in zip(model.state_names, map(np.flatnonzero, left.T), strict=True):
            first = _instant(verdicts.transient, int(rows[0])) if len(rows) else None
            states[name] = {"outside": len(rows), "first": first}
        count, outside = int((~np.isnan(table).all(axis=1)).sum()), int(left.any(axis=1).sum())
        inside = _inside(outside, count)
        found.append({"steps": steps, "windows": count, "outside": outside, "inside": inside, "states": states})
    return found


def _repeats(model: UncertainLTI, verdicts: Verdicts, which: Mask) -> list[dict[str, Any]]:
    """The repeats that some samples (N+1, n) belong to, in order of time; without those that go on to be frozen."""
    if model.repeats is None or not which.any():
        return []
    transient, spans, found = verdicts.transient, dict[tuple[int, int], tuple[int, int]](), []
    z = np.hstack([transient.x, transient.u])
    ever = np.fmax.reduce(z) - np.fmin.reduce(z)  # without NaN
    for i in range(model.n):
        fresh = np.concatenate([[True], (np.diff(transient.x[:, i]) != 0) | (np.diff(transient.segment) > 0)])
        begins = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
        for start, stop in runs(which[:, i]):
            if not verdicts.frozen[start, i] and stop < len(which) and verdicts.frozen[stop, i]:
                continue
            key = i, int(begins[start])
            spans[key] = spans.get(key, (start,))[0], stop  # where verdicts pause, the repeat goes on
    for (i, begin), (since, stop) in spans.items():
        name, longest = model.state_names[i], float(model.repeats.longest_repeat_s[i])
        seconds, told = (float(transient.t_ns[k] - transient.t_ns[begin]) * 1e-9 for k in (stop - 1, since))
        moving = np.flatnonzero(np.fmax.reduce(z[begin:stop]) - np.fmin.reduce(z[begin:stop]) > MOVES * ever)
        repeat = {
            "state": name,
            **_instant(transient, begin),
            "seconds": seconds,
            "told_after": told,
            "longest_in_fit": longest,
            "why": verdicts.why_frozen.get((since, i), ""),
            "moving": [model.signals.signals[j].name for j in moving],
            "text": f"{name} {repeat_words(seconds, longest)} from {instant_text(_instant(transient, begin))}",
        }
        found.append(repeat)
    return sorted(found, key=lambda repeat: (repeat["k"], repeat["state"]))


def long_repeats(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The longest repeat of each state, if far longer than any of the fit; the longest first."""
    far = [r for r in data["repeats"] if far_longer(r["seconds"], r["longest_in_fit"])]
    every = {r["state"]: r for r in sorted(far, key=lambda repeat: repeat["seconds"])}
    return sorted(every.values(), key=lambda repeat: -repeat["seconds"])


def _explained(model: UncertainLTI, verdicts: Verdicts) -> Iterator[dict[str, Any]]:
    """What the alarms look like, those close to one another together."""
    for start, stop, explainer in over_recording(model, verdicts):
        like = explainer.likeness()
        if like is not None and like.verdicts >= LEAST:
            yield {
                **_span(verdicts.transient, start, stop + 1),
                "label": like.label or None,
                "matches": dict(like.matches),
                "parts": [part._asdict() for part in like.parts],
                "first": list(like.first),
                "verdicts": like.verdicts,
                "text": like.words,
            }


def _episodes(verdicts: Verdicts) -> Iterator[Index]:
    """The violated samples of each episode: fewer than `APART` verdicts lie between them, and no step back in time."""
    rows = np.flatnonzero(verdicts.violated)
    if len(rows):
        order = np.cumsum(verdicts.judged)[rows]
        back = np.concatenate([[0], np.cumsum(np.diff(verdicts.transient.t_ns) < 0)])[rows]
        yield from np.split(rows, np.flatnonzero((np.diff(order) > APART) | (np.diff(back) > 0)) + 1)


def _episode(model: UncertainLTI, verdicts: Verdicts, rows: Index) -> dict[str, Any]:
    first, last = int(rows[0]), int(rows[-1])
    states = {}
    for i, name in enumerate(model.state_names):
        bad = rows[verdicts.flags[rows, i] == 1.0]
        if len(bad):
            states[name] = {
                "violations": len(bad),
                "first": _instant(verdicts.transient, int(bad[0]))["t"],
                **_worst(verdicts, i, bad),
            }
    ends = {name: _instant(verdicts.transient, k) for name, k in (("first", first), ("last", last))}
    alarm = bool(verdicts.alarm[first : last + 1].any())
    return {**ends, "verdicts_violated": len(rows), "alarm": alarm, "states": states}


class PerSample:
    """A verdict per sample as plain data, made when it is looked at: of a million samples all take 2 GB."""

    def __init__(self, model: UncertainLTI, verdicts: Verdicts) -> None:
        names = [*NUMBERS, *["horizon_utilisation"] * bool(model.horizons)]
        self._numbers = {name: getattr(verdicts, name) for name in names}
        self._verdicts, self._statuses = verdicts, verdicts.statuses()
        self._blocks = None if model.schedule is None else sample_blocks(model, verdicts)

    def __len__(self) -> int:
        return len(self._statuses)

    def __getitem__(self, k: int) -> dict[str, Any]:
        return self._of(slice(k, k + 1))[0]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for k in range(0, len(self), _TOGETHER):
            yield from self._of(slice(k, k + _TOGETHER))

    def _of(self, on: slice) -> list[dict[str, Any]]:
        verdicts = self._verdicts
        lists = {
            "t_ns": verdicts.transient.t_ns[on].tolist(), "status": [status.value for status in self._statuses[on]],
            **{name: _nulls(values[on]) for name, values in self._numbers.items()},
            **{name: getattr(verdicts, name)[on].tolist() for name in ("outside_domain", "alarm")},
        }  # fmt: skip
        if self._blocks is not None:
            lists["unknown_regime"] = verdicts.unknown_regime[on].tolist()
            lists["regime"] = [r if r >= 0 else None for r in self._blocks[on].tolist()]
        return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def _nulls(values: Array) -> list[Any]:
    """Numbers as lists, None in place of those that are not finite."""
    return list(np.ma.masked_invalid(values).tolist())


def _why_unknown(model: UncertainLTI, verdicts: Verdicts, data: dict[str, Any]) -> str:
    """Why a check says nothing of the machine; empty if it does."""
    judged = data["verdicts"]
    steps = max(int(verdicts.asked.sum()) - 1, 1)
    if not judged:
        met = Counter(verdicts.statuses())
        most = max(met, key=lambda s: (s not in (Status.FIRST, Status.UNASKED), met[s]), default=Status.FIRST)
        said = ["no verdict was possible, so nothing is known", *data["unknown"]]
        if most is Status.STEP:
            said.append(f"{why_not(most, model)}, and most here take {np.median(verdicts.transient.dt):.3g} s")
        return "; ".join([*said, _REMEDIES[most]])
    if judged < JUDGED * steps:
        why = f" ({', '.join(data['no_verdict'])})" if data["no_verdict"] else ""
        return f"only {judged} of {steps} steps could be judged{why}"
    if not (verdicts.armed & verdicts.judged).any():
        remedy = "give others, or check a recording in which the machine is in use"
        return f"the alarm was armed at no verdict: --enable did not hold, or --grace was not over; {remedy}"
    if (outside := data["outside_domain_share"]) > vouched(model):
        ask = "is this the same machine, in the same units? " if outside > STRANGE else ""
        why = "; ".join(filter(None, [data["beyond"], *data["unknown"]]))
        beyond_fit = f"{outside:.2%} of the verdicts are outside the fitted domain"
        remedy = f"{ask}fit recordings that reach as far{': ' * bool(why)}{why}"
        return f"{beyond_fit}, where nothing vouches for the bounds; {remedy}"
    alarm = model.fit_summary.get("alarm")
    if isinstance(alarm, dict) and (alarm.get("worth") == "none" or data["alarm"] and alarm.get("worth") == "unproven"):
        return f"the model is {alarm['headline']}"
    fitted = model.domain.span(model.operating_point.X)
    fitted[np.isinf(fitted)] = 0.0  # of a model that was given
    hardly = np.minimum(MOVES * fitted, [s["mean_width"] or 0.0 for s in data["states"].values()])
    moved = np.ptp(verdicts.transient.x[verdicts.judged], axis=0)
    if (model.domain.x_max > model.domain.x_min).any() and (moved <= hardly).all():
        return "nothing that is judged moves in it by more than its bounds are wide, so its quiet says nothing"
    alarmed = verdicts.alarm[verdicts.judged]
    if alarmed.mean() > STRANGE and alarmed[: max(1, judged // 10)].any():
        other = "this is another machine, in other units, or run as in no recording of the fit"
        up = f"the alarm is up for {alarmed.mean():.0%} of it, from early on"
        return f"{up}: the fault was there before, or {other}"
    return ""


def _inside(bad: int, count: int) -> float | None:
    return 1.0 - bad / count if count else None


def _instant(transient: Transient, k: int) -> dict[str, Any]:
    """Sample k: its time since the first sample, s, and its stamp, ns."""
    t_ns = transient.t_ns
    return {"k": k, "t": float((t_ns[k] - t_ns[0]) * 1e-9), "t_ns": int(t_ns[k])}


def _span(transient: Transient, start: int, stop: int) -> dict[str, Any]:
    """The first of some samples, and the time to the last of them, s; steps back to a further pass take none."""
    t_ns = np.append(transient.t_ns[start:stop], transient.t_ns[min(stop, len(transient) - 1)])
    first = np.flatnonzero(back_and_restarts(t_ns)[1]) - 1
    passed = t_ns[-2] - t_ns[0] + (t_ns[first - 1] - t_ns[first]).sum()
    return {**_instant(transient, start), "seconds": float(passed) * 1e-9}


# --- regimes -----------------------------------------------------------------------------------------------------


def check_regimes(model: UncertainLTI, verdicts: Verdicts) -> list[dict[str, Any]]:
    """What became of the verdicts in each regime; a verdict belongs to the block of the largest weight."""
    if model.schedule is None:
        return []
    block, found = sample_blocks(model, verdicts), []
    for r in range(model.schedule.blocks):
        rows = np.flatnonzero(block == r)
        bad, violated = (verdicts.flags[rows] == 1.0).sum(axis=0), int(verdicts.violated[rows].sum())
        own = (~np.isnan(verdicts.flags[rows])).sum(axis=0)  # without those withheld as a state is frozen
        total = np.nansum((verdicts.upper - verdicts.lower)[rows], axis=0)
        states = {}
        for i, name in enumerate(model.state_names):
            count, violations = int(own[i]), int(bad[i])
            inside, width = _inside(violations, count), float(total[i] / own[i]) if count else None
            states[name] = {"verdicts": count, "violations": violations, "inside": inside, "mean_width": width}
        found.append(
            {
                "regime": model.block_name(r),
                "verdicts": len(rows),
                "violated": violated,
                "inside": _inside(violated, len(rows)),
                "unknown_regime": int(verdicts.unknown_regime[rows].sum()),
                "states": states,
            }
        )
    return found


def sample_blocks(model: UncertainLTI, verdicts: Verdicts) -> Index:
    """The block of the largest weight for the verdict on each sample (N+1,); -1 where there is no verdict."""
    return np.where(verdicts.judged, model.main_block(_before(model, verdicts)), -1)


def _before(model: UncertainLTI, verdicts: Verdicts) -> Array:
    """Normalised [x; u; s] at the sample before each, (n + m + q, N+1); NaN where a verdict has none."""
    steps = verdicts.transient.transitions()
    z = np.full((model.n + model.m + model.q, len(verdicts.transient)), math.nan)
    z[:, steps.k + 1] = model.normalised_columns(steps)
    return z


def _beyond(model: UncertainLTI, verdicts: Verdicts) -> str:
    """Which signals lie beyond what was fitted, and where; of regimes that are unknown `unknown_in_words` tells."""
    rows = np.flatnonzero(verdicts.outside_domain & ~verdicts.unknown_regime)
    before = Transitions(verdicts.transient, rows - 1)
    return outside_in_words(model, model.normalised_columns(before)) if len(rows) else ""


def unknown_in_words(model: UncertainLTI, verdicts: Verdicts) -> list[str]:
    """Why regimes are unknown, and modes not in the model, each reason once with its count."""
    if model.schedule is None or not (verdicts.unknown_regime.any() or verdicts.unlisted_mode.any()):
        return []
    s, point, found = _before(model, verdicts)[model.scheduling_positions], model.operating_point, []
    for axis, i, values in zip(model.schedule.axes, model.scheduling_positions, s, strict=True):
        unit = f" {model.signals.signals[i].unit}".rstrip()

        def numbers(normalised: Any, i: int = i) -> list[str]:
            of = recorded(np.asarray(normalised), float(point.steady[i]), float(point.scale[i]))
            return [f"{v:.6g}" for v in of.tolist()]

        if axis.knots:
            far = values[verdicts.judged & ((values < axis.knots[0]) | (values > axis.knots[-1]))]
            if len(far):
                reached = " to ".join(dict.fromkeys(numbers([far.min(), far.max()])))
                ends = " to ".join(numbers([axis.knots[0], axis.knots[-1]]))
                often = f"in {plural(len(far), 'verdict')} ({reached})"
                found.append(f"{axis.signal} is beyond its knots, {ends}{unit}, {often}")
            continue
        there = values[verdicts.unlisted_mode]
        if len(odd := there[~np.isin(there, axis.modes)]):
            listed, strange = shortlist(numbers(axis.modes), 6), shortlist(numbers(np.unique(odd)), 6)
            other = f"{plural(len(odd), 'sample')} with {strange} {'has' if len(odd) == 1 else 'have'} no verdict"
            found.append(f"the model lists {axis.signal} = {listed}{unit}, and {other}")
    places, weights = model.schedule.corners(s[:, verdicts.unknown_regime])
    counts = [int(((places == r) & (weights > 0)).any(axis=0).sum()) for r in range(model.schedule.blocks)]
    there = [(r, count) for r, count in enumerate(counts) if count and not model.block_data[r].known]
    met = [f"{model.block_name(r)} ({plural(count, 'verdict')})" for r, count in there]
    return found + [f"no recording visited {shortlist(met, 6)}"] * bool(met)


# --- text --------------------------------------------------------------------------------------------------------


def check_text(data: dict[str, Any]) -> str:
    """Summary of `check_data` for a person."""
    return text_of(check_blocks(data))


def check_blocks(data: Mapping[str, Any]) -> list[str | Table]:
    """Summary of `check_data`, what weighs most first and what came of it last."""
    blocks: list[str | Table] = []
    if data["outcome"] == "unknown":
        blocks.append(f"UNKNOWN: {data['reason']}")
    elif data["alarm"] and data["reason"]:
        blocks.append(f"ALARM, and beware: {data['reason']}")
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} inside all bounds"
    left = f"; no verdict or not used: {', '.join(data['no_verdict'])}" if data["no_verdict"] else ""
    samples = f"{plural(data['samples'], 'sample')}, {plural(data['verdicts'], 'verdict')}"
    blocks.append(f"{data['recording']}: {samples}, {inside}{left}")
    blocks += _tables(data)
    if data["verdicts"]:
        where = f": {data['beyond']}" * (data["beyond"] not in data["reason"])
        blocks.append(f"outside the fitted domain: {data['outside_domain_share']:.2%} of the verdicts{where}")
        if data["unknown_regime"]:
            often = f"{data['unknown_regime'] / data['verdicts']:.2%}"
            blocks.append(f"unknown regime: {often} of the verdicts, which nothing vouches for")
    blocks += [f"  {text}" for text in data["unknown"]]
    jumps = filter(None, (s["jump"] for s in data["states"].values()))
    by_size = sorted(jumps, key=lambda j: j["largest_in_fit"] / abs(j["change"]))
    blocks += _first([f"{j['text']} at {instant_text(j)}" for j in by_size], "jump")
    frozen = [f"FROZEN: {r['text']}, told after {lasting(r['told_after'] / 3600)}, {r['why']}" for r in data["frozen"]]
    blocks += _first(frozen, "frozen repeat")
    rest = "as of a machine at rest: the model does not move it"
    longest = [(r["text"], f"while {shortlist(r['moving'], 3)} moved" * bool(r["moving"])) for r in long_repeats(data)]
    blocks += _first([f"warning: {text}, {moved or rest}" for text, moved in longest], "warning")
    told = [f"the alarm from {instant_text(like)} {like['text']}" for like in data["explained"] if like["text"]]
    return [*blocks, *_first(told, "alarm"), *_alarms(data)]


def _tables(data: Mapping[str, Any]) -> Iterator[Table]:
    rows, states = [], list(data["states"].items())
    if len(states) > Table.most:  # those most often outside are shown
        states.sort(key=lambda state: -state[1]["violations"])
    for name, s in states:
        counts = [str(s["violations"]), share(s["inside"]), number(s["mean_width"]), share(s["width_to_range"], 2)]
        worst = beyond(s["worst"]["utilisation"]) if s["violations"] else "-"
        when = "-" if s["first_violation"] is None else instant_text(s["first_violation"])
        rows.append([named(name, s["unit"]), *counts, when, worst])
    yield Table(("state", "violations", "inside", "mean width", "width/range", "first", "worst"), rows)
    if data["horizons"]:
        rows = []
        for h in data["horizons"]:
            gone = [(s["first"]["t"], name) for name, s in h["states"].items() if s["first"] is not None]
            first, where = (f"{min(gone)[0]:.4f} s", min(gone)[1]) if gone else ("-", "-")
            rows.append([str(h["steps"]), str(h["windows"]), share(h["inside"]), first, where])
        yield Table(("steps", "windows", "inside", "first outside", "state"), rows)
    if len(data["regimes"]) > 1 and (visited := [r for r in data["regimes"] if r["verdicts"]]):
        header = ("regime", "verdicts", "inside", "unknown", *(f"{name}: mean width" for name in data["states"]))
        rows = []
        for r in visited:
            widths = [number(state["mean_width"]) for state in r["states"].values()]
            rows.append([r["regime"], str(r["verdicts"]), share(r["inside"]), str(r["unknown_regime"]), *widths])
        yield Table(header, rows)


def _alarms(data: Mapping[str, Any]) -> Iterator[str]:
    if alarms := data["alarms"]:
        longest_alarm = max(alarms, key=lambda alarm: alarm["seconds"])
        heads = [(f"ALARM: raised {times(len(alarms))}, first at", alarms[0]), ("  the longest at", longest_alarm)]
        for head, alarm in heads[: 1 + (longest_alarm is not alarms[0])]:
            by = ", ".join(raised_by(alarm)[:MOST_SHOWN])
            yield from [f"{head} {_when(alarm)}", *[f"  raised by {by}"] * bool(by)]
        if (far := data["farthest"]) and far["k"] not in {alarm["k"] for _, alarm in heads}:
            yield f"  the largest: {far['words']}, at {instant_text(far)}"
        yield from (f"  {text}, and fit again" for text in data["jitter"])
    elif data["verdicts"]:
        if near := data["farthest"]:
            yield f"nearest to an alarm: {near['words']}, at {instant_text(near)}"
        yield "no alarm" + ", which says nothing: see the first line" * (data["outcome"] == "unknown")


def _when(alarm: Mapping[str, Any]) -> str:
    """When an alarm was raised, and for how long."""
    at, seconds = instant_text(alarm), alarm["seconds"]
    last = f"for {number(seconds)} s" if seconds < 120 else f"for {lasting(seconds / 3600)}"
    return f"{at}{',' * at.endswith('on')} {last if seconds else 'for one verdict'}"


def instant_text(instant: Mapping[str, Any], form: str = ".4f") -> str:
    """When a sample was, s from the first one; its day as well where that is another."""
    if instant["t"] < 86400 or instant["t_ns"] <= DATED_NS:
        return f"{instant['t']:{form}} s"
    day = np.datetime64(instant["t_ns"], "ns").astype("datetime64[s]")
    return f"{day} UTC, {lasting(instant['t'] / 3600)} on"


def raised_by(alarm: Mapping[str, Any]) -> list[str]:
    """What raised it, farthest beyond its threshold first; none where containment alone did."""
    by = [r for r in alarm["raised"] if r["rule"] != "containment"]
    words = [r["words"] for r in sorted(by, key=lambda r: -abs(r["value"]))]
    return words + [f"a frozen {name}" for name in alarm["frozen"]]


def _first(lines: list[str], word: str) -> list[str]:
    more = len(lines) - MOST_SHOWN
    return lines[:MOST_SHOWN] + [f"  and {plural(more, f'more {word}')}; --json has all"] * (more > 0)
