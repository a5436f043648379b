"""Findings: whether a model may be relied on and what happened in recordings, as plain data with the reasons."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti import __version__
from uncertain_lti.base.english import plural, times
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import sha256, target
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import Verdicts
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.reports.text import check_data, number

CAUTION_WIDTH, TOO_WIDE = 0.25, 0.5
"""Mean width of the one-step bounds as a share of the state's own range, in the recordings or in the fit."""
RUNS_AWAY = 1.2
"""Spectral radius of the nominal recursion from which on it says little of the machine even for a few steps."""
CAUTION_INSIDE, TOO_FEW_INSIDE = 0.99, 0.9
"""Share of the verdicts on left-out recordings that lie inside all bounds."""
OUTSIDE_DOMAIN, WITHOUT_VERDICT = 0.05, 0.2
"""Shares of the verdicts outside the fitted ranges, and of the samples without a verdict."""
APART = 10
"""Verdicts without a violation that end an episode."""
MOST_EPISODES = 1000

YES, CARE, UNKNOWN, NO = "yes", "with care", "unknown", "no"
WEIGHTS = (NO, UNKNOWN, CARE, YES)
"""From what weighs most: the answer is the first that some reason has."""
MOST_VIOLATED = 0.5
"""Share of the verdicts violated from which on a model is refused of which nothing shows that it ever holds."""


def findings(
    model: UncertainLTI,
    model_file: str | os.PathLike[str],
    checked: Sequence[Verdicts],
    rule: AlarmRule | None = None,
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
    recordings = [_recording(model, verdicts) for verdicts in checked]
    validation = _validation(model)
    reasons = [
        *_fit_reasons(model),
        *_stability_reasons(model),
        *_validation_reasons(validation, model),
        *_width_reasons(model, recordings),
        *_recording_reasons(model, recordings, validation),
    ]
    weights = {YES, *(r["weight"] for r in reasons)}
    facts: dict[str, Any] = {
        "version": __version__,
        "rely": {"answer": next(w for w in WEIGHTS if w in weights), "reasons": reasons},
        "happened": [_happened(r) for r in recordings],
        "alarm": any(r["alarm"] for r in recordings),
        "rule": {"violations": rule.violations, "window": rule.window, "margin": rule.margin},
        "model": _model(model, model_file),
        "validation": validation,
        "recordings": recordings,
    }
    finite: dict[str, Any] = _finite(facts)
    return finite


def page_target(wish: str | os.PathLike[str] | None, model_file: str, bags: Sequence[Recording]) -> Path | None:
    """Where the page goes; an older page gives way, a recording or the model never.

    Parameters
    ----------
    wish : path or None
        What the user named; None for no page.
    model_file : str
        The model, which is never replaced.
    bags : sequence of Recording
        The recordings, which are never replaced.

    Returns
    -------
    Path or None
        The path, or None without a wish.

    Raises
    ------
    BagError
        The place is one of them, or its folder is not there.
    """
    if wish is None:
        return None
    path = Path(wish)
    for other in (Path(model_file), *(part for bag in bags for part in bag.parts)):
        if path.exists() and other.exists() and path.samefile(other):
            raise BagError(f"{path}: is what the report is about; choose another name")
    return target(path, holds=b"<html", kind="page", example="report.html")


def shortened(name: str, longest: int = 40) -> str:
    """A name for a sentence, with its middle left out where it is long.

    Parameters
    ----------
    name : str
        Any name.
    longest : int, default 40
        Its length at most, in characters.

    Returns
    -------
    str
        The name, with an ellipsis where its middle is left out.
    """
    return name if len(name) <= longest else f"{name[: longest // 2]}…{name[len(name) - longest // 2 + 1 :]}"


def _model(model: UncertainLTI, model_file: str | os.PathLike[str]) -> dict[str, Any]:
    fit = model.fit_summary
    known = {
        key: fit[key]
        for key in ("criterion", "additive", "transitions", "transients", "violations", "objective", "gap", "rank")
        if isinstance(fit.get(key), (str, int, float))
    }
    width = _numbers(fit.get("mean_width_recorded"), model.n), _numbers(fit.get("max_width_recorded"), model.n)
    return {
        "file": os.fspath(model_file),
        "sha256": sha256(model_file) if os.path.isfile(model_file) else None,
        "fit": known,
        "messages": [str(m) for m in _list(fit.get("messages"))],
        "sources": [
            {"file": str(s.get("file", "")), "sha256": str(s.get("sha256", ""))}
            for s in _list(fit.get("sources"))
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
        "eigenvalues": [[float(v.real), float(v.imag)] for v in model.eigenvalues()],
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
                    **{key: int(alarm[key]) for key in ("violations", "window", "alarms")},
                    **{key: _real(alarm[key]) for key in ("margin", "per_hour")},
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


# --- may I rely on it ---------------------------------------------------------------------------------------------


def _reason(weight: str, about: str, text: str) -> dict[str, str]:
    return {"weight": weight, "about": about, "text": text}


def _fit_reasons(model: UncertainLTI) -> list[dict[str, str]]:
    messages = [str(message) for message in _list(model.fit_summary.get("messages"))]
    # of widths it is said below, from the recordings at hand too
    found = [_reason(CARE, "fit", message) for message in messages if not message.startswith("the bounds are over")]
    if not model.fit_summary:
        found.append(_reason(CARE, "fit", "the model file does not say how it was fitted"))
    return found


def _stability_reasons(model: UncertainLTI) -> list[dict[str, str]]:
    """A nominal model that multiplies a deviation at every step is no picture of the machine."""
    if model.sampling.dt_median is None or not math.isfinite(radius := model.spectral_radius()) or radius <= RUNS_AWAY:
        return []
    if any("spectral radius" in str(message) for message in _list(model.fit_summary.get("messages"))):
        return []  # the fit said so
    text = f"the nominal model runs away: a deviation can grow {number(radius)} times in a step (spectral radius)"
    return [_reason(CARE, "stability", text)]


def _validation_reasons(validation: Mapping[str, Any] | None, model: UncertainLTI) -> list[dict[str, str]]:
    if validation is None or validation["inside"] is None:
        how = "run `uncertain-lti validate MODEL --output MODEL` where its recordings are"
        why = f" ({why})" if (why := model.validation.get("not_done")) else ""
        text = f"it has not been validated{why}, so how it does on other recordings is unknown; {how}"
        return [_reason(UNKNOWN, "validation", text)]
    what = "recordings" if validation["kind"] == "transients" else "blocks"
    inside = float(validation["inside"])
    weight = NO if inside < TOO_FEW_INSIDE else CARE if inside < CAUTION_INSIDE else YES
    if 2 * validation["parts_inside"] < validation["parts"] and weight == YES:
        weight = CARE  # few violations, and yet nearly every run has some: an alarm on one of them would be a habit
    text = (
        f"of {plural(validation['verdicts'], 'verdict')} on {what} that were left out of the fit "
        f"{_percent(inside)} lay inside "
        f"({validation['parts_inside']} of {validation['parts']} whole {what})"
    )
    if validation["kind"] != "transients":
        text += "; they are of the same run, so another day may differ"
    found = [_reason(weight, "validation", text)]
    if validation["hint"]:
        found.append(_reason(CARE, "validation", validation["hint"]))
    return found


def _width_reasons(model: UncertainLTI, recordings: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Bounds about as wide as what the state does contain everything, and say nothing.

    Widths and ranges are those of the fit, as the fit itself prints them; of a model that does not say them, those of
    the recordings at hand: the least share, as a recording in which a state hardly moves says nothing.
    """
    wide: dict[str, float] = {}
    span = model.domain.x_max - model.domain.x_min
    widths = _numbers(model.fit_summary.get("mean_width"), model.n) or [math.nan] * model.n
    for name, width, of in zip(model.state_names, widths, span, strict=True):
        if math.isfinite(of) and of > 0 and math.isfinite(width):
            wide[name] = width / float(of)
    where = "in the fit" if wide else "in what was checked"
    for recording in recordings if not wide else []:
        for name, state in recording["states"].items():
            if (share := state["width_to_range"]) is not None:
                wide[name] = min(wide.get(name, math.inf), share)
    if not wide:
        return []
    names = [name for name, share in wide.items() if share > CAUTION_WIDTH]
    useless = [name for name in names if wide[name] > TOO_WIDE]
    if useless:
        listed = ", ".join(f"{shortened(name)} ({wide[name]:.0%})" for name in useless[:6])
        listed += " ..." if len(useless) > 6 else ""
        text = f"bounds over {TOO_WIDE:.0%} as wide as the state's own range {where} say next to nothing: {listed}"
        return [_reason(NO if 2 * len(useless) >= model.n else CARE, "tightness", text)]
    worst = max(wide, key=lambda name: wide[name])
    text = f"one-step bounds are at most {wide[worst]:.3g} times as wide as the state's own range {where} "
    return [_reason(CARE if names else YES, "tightness", f"{text}({shortened(worst)})")]


def _recording_reasons(
    model: UncertainLTI, recordings: Sequence[Mapping[str, Any]], validation: Mapping[str, Any] | None
) -> list[dict[str, str]]:
    found = []
    fitted = {s.get("sha256") for s in _list(model.fit_summary.get("sources")) if isinstance(s, Mapping)} - {None, ""}
    judged = sum(r["verdicts"] for r in recordings)
    same = [r["recording"] for r in recordings if any(f["sha256"] in fitted for f in r["files"])]
    if same:
        names = ", ".join(os.path.basename(name) for name in same[:4]) + (" ..." if len(same) > 4 else "")
        text = f"checked on what it was fitted to ({names}), which it contains by construction: that proves nothing"
        found.append(_reason(CARE, "recordings", text))
    if not judged:
        found.append(
            _reason(NO, "recordings", "no verdict was possible on what was checked, so nothing is known of it")
        )
        return found
    violated = sum(r["violated"] for r in recordings) / judged
    if violated > MOST_VIOLATED and (validation is None or validation["inside"] is None):
        text = (
            f"{_percent(violated)} of the verdicts are violated, and nothing shows that the model holds on any healthy "
            f"recording that it was not fitted to: such a verdict cannot tell a fault"
        )
        found.append(_reason(NO, "recordings", text))
    outside = sum(r["outside_domain"] for r in recordings) / judged
    if outside > OUTSIDE_DOMAIN:
        text = f"{_percent(outside)} of the verdicts are on samples outside the ranges seen in the fit"
        found.append(_reason(CARE, "recordings", text))
    samples = sum(r["samples"] for r in recordings)
    silent = 1.0 - judged / samples
    if silent > WITHOUT_VERDICT:
        found.append(
            _reason(CARE, "recordings", f"{_percent(silent)} of the samples have no verdict (gaps, missing values)")
        )
    return found


def _happened(recording: Mapping[str, Any]) -> dict[str, Any]:
    """One sentence, and whether there is something to look at."""
    judged, bad = recording["verdicts"], recording["violated"]
    if not judged:
        return {"recording": recording["recording"], "state": "unknown", "text": "no verdict was possible"}
    over = f"{plural(judged, 'verdict')} over {number(recording['seconds'])} s"
    if not bad:
        return {"recording": recording["recording"], "state": "quiet", "text": f"{over}: every one inside all bounds"}
    states = {name: s["violations"] for name, s in recording["states"].items() if s["violations"]}
    most = sorted(states, key=lambda name: -states[name])[:3]
    text = f"{over}: {bad} violated, {_episodes_word(recording['episode_count'])}, first at "
    listed = ", ".join(f"{shortened(name)} ({states[name]})" for name in most)
    text += f"{recording['episodes'][0]['first']['t']:.8g} s; most often {listed}"
    if recording["alarm"]:
        first = recording["alarms"][0]
        text += f". The alarm was raised {times(len(recording['alarms']))}, first at {first['t']:.8g} s"
        return {"recording": recording["recording"], "state": "alarm", "text": text}
    return {"recording": recording["recording"], "state": "violations", "text": f"{text}. The alarm was not raised"}


def _episodes_word(count: int) -> str:
    return "in one episode" if count == 1 else f"in {count} episodes"


def _percent(share: float) -> str:
    """Never 100 % of what is not all."""
    text = f"{100 * share:.2f}"
    if text == "100.00" and share < 1.0:
        text = "over 99.99"
    return f"{text} %"


def _numbers(value: Any, count: int) -> list[float] | None:
    good = isinstance(value, (list, tuple)) and len(value) == count and all(isinstance(v, (int, float)) for v in value)
    return [float(v) for v in value] if good else None


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (list, tuple)) else []


def _finite(value: Any) -> Any:
    """The same plain data, with None for numbers that JSON has no text for."""
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
