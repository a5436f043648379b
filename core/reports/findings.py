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
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from uncertain_lti import __version__
from uncertain_lti.base.files import sha256
from uncertain_lti.base.text import (
    Table,
    finite_data,
    lasting,
    list_of,
    number,
    numbers_of,
    plural,
    shortened,
    shortlist,
    times,
)
from uncertain_lti.identification.diagnosis import HARMLESS
from uncertain_lti.model.alarm_rule import AlarmRule, with_containment
from uncertain_lti.model.domain import UNVOUCHED
from uncertain_lti.model.interchange import block_facts
from uncertain_lti.model.model_file import sources_of
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import times_text
from uncertain_lti.monitor.deployed import drift_in_words
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports.check import OUTCOMES, check_data, instant_text, long_repeats, raised_by
from uncertain_lti.reports.model_text import blocks_in_words, detectable_data, detectable_words, readable_validation

CAUTION_WIDTH, TOO_WIDE = 0.25, 0.5
"""Mean width of the one-step bounds as a share of the state's own range, in the recordings or in the fit."""
CAUTION_INSIDE, TOO_FEW_INSIDE = 0.99, 0.9
"""Share of the verdicts on left-out recordings that lie inside all bounds."""
OUTSIDE_DOMAIN, WITHOUT_VERDICT = 0.05, 0.2
"""Shares of the verdicts outside the fitted ranges, and of the samples without a verdict."""
MOST_VIOLATED = 0.5
"""Share of the verdicts violated from which on a model is refused of which nothing shows that it ever holds."""
_MOST_TOLD = 20
"""Recordings of which a line is printed each; of more, those in alarm first."""
YES, CARE, UNKNOWN, NO = "yes", "with care", "unknown", "no"
WEIGHTS = (NO, UNKNOWN, CARE, YES)
"""From what weighs most: the answer is the first that some reason has."""
_KNOWN = ("criterion", "additive", "transitions", "transients", "violations", "objective", "optimality_gap", "rank")

Reasons = Iterator[tuple[str, str, str]]
"""Weight, subject and sentence of each reason."""


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
        `rely`: an answer (yes, with care, unknown, no) and its reasons, what weighs most first; `happened`: a sentence
        per recording; `sees`: which faults it would see, an answer and sentences; `model`, `validation` and
        `recordings` what they rest on. `recordings` holds what `check --json` says, and the files with their checksums.

    Raises
    ------
    OSError
        A file of a recording cannot be read.
    """
    rule = rule or model.alarm_rule
    rules = model.alarm if rule == model.alarm_rule else with_containment(model.alarm, rule)
    recordings = [check_data(model, verdicts, samples=False) for verdicts in checked]
    for recording, verdicts in zip(recordings, checked, strict=True):
        recording["files"] = [{"file": path, "sha256": sha256(path)} for path in verdicts.transient.sources]
    validation = readable_validation(model.validation)
    reasons = [*_fit_reasons(model), *_regime_reasons(model, recordings), *_validation_reasons(model, validation)]
    reasons += [*_width_reasons(model, recordings), *_recording_reasons(model, recordings, validation)]
    reasons.sort(key=lambda reason: WEIGHTS.index(reason[0]))
    fit = model.fit_summary
    facts: dict[str, Any] = {
        "version": __version__,
        "rely": {
            "answer": reasons[0][0] if reasons else YES,
            "reasons": [dict(zip(("weight", "about", "text"), reason, strict=True)) for reason in reasons],
        },
        "happened": [_happened(r) for r in recordings],
        "sees": _sees(model, os.fspath(model_file), validation),
        "alarm": any(r["alarm"] for r in recordings),
        "rule": {
            "words": "; or ".join(one.words for one in rules),
            "violations": rule.violations,
            "window": rule.window,
            "margin": rule.margin,
            "conditions": conditions,
        },
        "model": {
            "file": os.fspath(model_file),
            "sha256": sha256(model_file) if os.path.isfile(model_file) else None,
            "fit": {key: fit[key] for key in _KNOWN if isinstance(fit.get(key), (str, int, float))},
            "messages": _messages(model),
            "sources": sources_of(model),
            "regimes": block_facts(model),
        },
        "validation": validation,
        "recordings": recordings,
    }
    return {key: finite_data(value) for key, value in facts.items()}


def findings_text(facts: Mapping[str, Any]) -> str:
    """What `report` prints of `findings`."""
    lines = [f"may I rely on it? {facts['rely']['answer']}"]
    lines += [f"  {r['weight']}: {r['text']}" for r in facts["rely"]["reasons"]]
    lines.append("what happened?")
    happened = facts["happened"]
    if (more := len(happened) - _MOST_TOLD) > 0:
        happened = by_outcome(happened)[:_MOST_TOLD]
    lines += [f"  {h['recording']}: {h['text']}" for h in happened]
    lines += [f"  and {more} more; the page and --json have all"] * (more > 0)
    lines.append(f"which faults would it see? {facts['sees']['answer']}")
    return "\n".join(lines + [f"  {text}" for text in facts["sees"]["texts"]])


def by_outcome(happened: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """What happened in recordings, those in alarm first."""
    return sorted(happened, key=lambda one: OUTCOMES.index(one["state"]))


def overview(recordings: Sequence[Mapping[str, Any]]) -> Table:
    """What came of each of several recordings, a row each."""
    rows = []
    for r in recordings:
        first = instant_text(r["alarms"][0]) if r["alarms"] else "-"
        size, of = (times_text(far["value"]), far["what"]) if (far := r["farthest"]) else ("", "")
        came = "ALARM" if r["alarm"] else "UNKNOWN" if r["reason"] else "no alarm"
        rows.append([r["recording"], came + ", beware" * bool(r["alarm"] and r["reason"]), first, size, of])
    header = ("recording", "outcome", "first alarm", "largest", "times the threshold of")
    return Table(header, rows, left=(1, 4), most=1000)


def _happened(recording: Mapping[str, Any]) -> dict[str, Any]:
    """One sentence, and whether there is something to look at."""
    judged, bad, state = recording["verdicts"], recording["violated"], recording["outcome"]
    text = f"{plural(judged, 'verdict')} over {lasting(recording['seconds'] / 3600)}: "
    if not judged:
        text = recording["reason"]
    elif not bad:
        text += "every one inside all bounds"
    else:
        states = {name: s["violations"] for name, s in recording["states"].items() if s["violations"]}
        most = sorted(states, key=lambda name: -states[name])[:3]
        count, first = recording["episode_count"], instant_text(recording["episodes"][0]["first"], ".8g")
        text += f"{bad} violated, in {'one episode' if count == 1 else f'{count} episodes'}, first at {first}; "
        text += f"most often {', '.join(f'{shortened(name)} ({states[name]})' for name in most)}"
    if bad and not recording["alarms"]:
        near = recording["farthest"]
        text += ". The alarm was not raised" + (f"; nearest to it came {near['words']}" if near else "")
    if judged and state == "unknown":
        text += f", but {recording['reason']}"
    if frozen := [f"{repeat['text']}, {repeat['why']}" for repeat in recording["frozen"]]:
        text = f"frozen: {shortlist(frozen, 1)}. {text}"
    elif held := [repeat for repeat in long_repeats(recording) if repeat["moving"]]:
        text += f". {held[0]['text']}, while {shortlist(held[0]['moving'], 3)} moved"
    if alarms := recording["alarms"]:
        by = "".join(f", by {words}" for words in raised_by(alarms[0])[:1])
        if (far := recording["farthest"]) and far["k"] != alarms[0]["k"]:
            by += f"; at most {times_text(far['value'])} times, by {far['what']} at {instant_text(far, '.8g')}"
        text = f"The alarm was raised {times(len(alarms))}, first at {instant_text(alarms[0], '.8g')}{by}. {text}"
    return {"recording": recording["recording"], "state": state, "text": text}


def _sees(model: UncertainLTI, file: str, validation: Mapping[str, Any] | None) -> dict[str, Any]:
    """Which faults it would see: those of the validation, else the jumps that the alarm promises to see."""
    faults, name = detectable_data(validation or {}), shlex.quote(file)
    validate = f"`uncertain-lti validate {name} --output {name}` finds it out"
    if faults is not None and not faults.get("refused"):
        answer = f"within {number(faults['within'])} s, from these sizes on"
        return {"answer": answer, "texts": detectable_words(faults)}
    if faults is None and (jumps := _promises(model, True)):
        texts = [*jumps, f"of drifts, noise, stuck sensors and more: {validate}"]
        return {"answer": "jumps of these sizes", "texts": texts}
    return {"answer": "unknown", "texts": [faults["refused"] if faults else validate]}


def _alarm(model: UncertainLTI) -> Mapping[str, Any]:
    """What the fit says of the alarm; anything may be written in a file."""
    alarm = model.fit_summary.get("alarm")
    return alarm if isinstance(alarm, Mapping) else {}


def _promises(model: UncertainLTI, of_jumps: bool) -> list[str]:
    texts = map(str, list_of(_alarm(model).get("promises")))
    return [text for text in texts if text.startswith("sees within") == of_jumps]


# --- reasons for and against relying on a model ------------------------------------------------------------------


def _messages(model: UncertainLTI) -> list[str]:
    return [str(message) for message in list_of(model.fit_summary.get("messages"))]


def _fit_reasons(model: UncertainLTI) -> Reasons:
    for message in _messages(model):  # widths and the blocks of a schedule have reasons of their own below
        if not message.startswith(("the bounds are over", "the block at")) and not any(w in message for w in HARMLESS):
            yield CARE, "fit", message
    if not model.fit_summary:
        yield CARE, "fit", "the model file does not say how it was fitted"


def _regime_reasons(model: UncertainLTI, recordings: Sequence[Mapping[str, Any]]) -> Reasons:
    """Regimes with little data, and verdicts in regimes that the model does not know."""
    for text in blocks_in_words(model):
        yield CARE, "regimes", text
    judged, unknown = (sum(r[key] for r in recordings) for key in ("verdicts", "unknown_regime"))
    why = "; ".join(dict.fromkeys(text for r in recordings for text in r["unknown"]))
    if judged and unknown:
        weight = UNKNOWN if unknown > UNVOUCHED * judged else CARE
        share = _percent(unknown / judged)
        yield weight, "regimes", f"{share} of the verdicts are in regimes that the model does not know: {why}"
    elif why:
        yield CARE, "regimes", why


def _validation_reasons(model: UncertainLTI, validation: Mapping[str, Any] | None) -> Reasons:
    alarm = _alarm(model)
    if alarm.get("headline"):
        weight = {"good": YES, "some": CARE, "unproven": UNKNOWN}.get(str(alarm.get("worth")), NO)
        yield weight, "alarm", "; ".join([str(alarm["headline"]), *_promises(model, False)])
    elif validation is None or validation["inside"] is None:
        how = "run `uncertain-lti validate MODEL --output MODEL` where its recordings are"
        why = f" ({why})" if (why := model.validation.get("not_done")) else ""
        unknown = f"it has not been validated{why}, so how it does on other recordings is unknown; {how}"
        yield UNKNOWN, "validation", unknown
        return
    else:
        inside, whole, parts = (validation[key] for key in ("inside", "parts_inside", "parts"))
        # few violations, and yet nearly every run may have some: an alarm on one would be a habit
        good = inside >= CAUTION_INSIDE and 2 * whole >= parts
        weight = NO if inside < TOO_FEW_INSIDE else YES if good else CARE
        what, but = "recordings", ""
        if validation["kind"] != "transients":
            what, but = "blocks", "; they are of the same run, so another day may differ"
        judged = f"of {plural(validation['verdicts'], 'verdict')} on {what} that were left out of the fit"
        yield weight, "validation", f"{judged} {_percent(inside)} lay inside ({whole} of {parts} whole {what}){but}"
    if validation is not None and validation.get("hint"):
        yield CARE, "validation", str(validation["hint"])


def _width_reasons(model: UncertainLTI, recordings: Sequence[Mapping[str, Any]]) -> Reasons:
    """Bounds about as wide as what the state does say nothing; widths are of the fit, else of what is at hand."""
    span = (model.domain.x_max - model.domain.x_min).tolist()
    widths = numbers_of(model.fit_summary.get("mean_width"), model.n) or [math.nan] * model.n
    of = zip(model.state_names, widths, span, strict=True)
    wide = {name: width / s for name, width, s in of if 0 < s < math.inf and math.isfinite(width)}
    where = "in the fit" if wide else "in what was checked"
    for name in model.state_names if not wide else ():
        shares = [r["states"][name]["width_to_range"] for r in recordings]
        wide[name] = min((share for share in shares if share is not None), default=0.0)
    worst = max(wide, key=lambda name: wide[name])
    useless = [f"{shortened(name)} ({wide[name]:.0%})" for name in model.state_names if wide.get(name, 0.0) > TOO_WIDE]
    if useless:
        # with an alarm that was learnt, a window sees less than a width says
        weight = NO if 2 * len(useless) >= model.n and not _alarm(model) else CARE
        wider = f"bounds over {TOO_WIDE:.0%} as wide as the state's own range {where} say next to nothing"
        yield weight, "tightness", f"{wider}: {shortlist(useless, 6)}"
    elif wide[worst] > 0.0:
        weight = CARE if wide[worst] > CAUTION_WIDTH else YES
        most = f"one-step bounds are at most {wide[worst]:.3g} times as wide as the state's own range {where}"
        yield weight, "tightness", f"{most} ({shortened(worst)})"


def _recording_reasons(
    model: UncertainLTI, recordings: Sequence[Mapping[str, Any]], validation: Mapping[str, Any] | None
) -> Reasons:
    fitted = {source["sha256"] for source in sources_of(model)} - {""}
    if same := [os.path.basename(r["recording"]) for r in recordings if any(f["sha256"] in fitted for f in r["files"])]:
        proves = "which it contains by construction: that proves nothing"
        yield CARE, "recordings", f"checked on what it was fitted to ({shortlist(same, 4)}), {proves}"
    judged = sum(r["verdicts"] for r in recordings)
    if not judged:
        yield NO, "recordings", "no verdict was possible on what was checked, so nothing is known of it"
        return
    violated, outside = (sum(r[key] for r in recordings) / judged for key in ("violated", "outside_domain"))
    silent = 1.0 - judged / sum(r["samples"] for r in recordings)
    if violated > MOST_VIOLATED and (validation is None or validation["inside"] is None):
        nothing = "nothing shows that the model holds on any healthy recording that it was not fitted to"
        text = f"{_percent(violated)} of the verdicts are violated, and {nothing}: such a verdict cannot tell a fault"
        yield NO, "recordings", text
    if outside > OUTSIDE_DOMAIN:
        farthest = sorted(recordings, key=lambda r: -int(r["outside_domain"]))
        each = list(dict.fromkeys(filter(None, (r["beyond"] for r in farthest))))
        where = "; ".join([*each[:2], *[f"and others in {plural(len(each) - 2, 'more recording')}"] * (len(each) > 2)])
        text = f"{_percent(outside)} of the verdicts are outside the ranges seen in the fit"
        yield CARE, "recordings", f"{text}: {where}" if where else text
    for text in drift_in_words(model, recordings):
        yield CARE, "drift", text
    if silent > WITHOUT_VERDICT:
        why = shortlist([reason for r in recordings for reason in r["no_verdict"]], 4)
        yield CARE, "recordings", f"{_percent(silent)} of the samples have no verdict ({why})"


def _percent(share: float) -> str:
    """Never 100 % of what is not all."""
    text = f"{100 * share:.2f}"
    return "over 99.99 %" if text == "100.00" and share < 1.0 else f"{text} %"
