# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Whether a model may be relied on: every reason for and against it, with its weight."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

from uncertain_lti.base.english import plural
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.check_data import UNVOUCHED
from uncertain_lti.reports.regimes import blocks_in_words
from uncertain_lti.reports.tables import list_of, number, numbers_of, shortened

CAUTION_WIDTH, TOO_WIDE = 0.25, 0.5
"""Mean width of the one-step bounds as a share of the state's own range, in the recordings or in the fit."""


RUNS_AWAY = 1.2
"""Spectral radius of the nominal recursion from which on it says little of the machine even for a few steps."""


CAUTION_INSIDE, TOO_FEW_INSIDE = 0.99, 0.9
"""Share of the verdicts on left-out recordings that lie inside all bounds."""


OUTSIDE_DOMAIN, WITHOUT_VERDICT = 0.05, 0.2
"""Shares of the verdicts outside the fitted ranges, and of the samples without a verdict."""


YES, CARE, UNKNOWN, NO = "yes", "with care", "unknown", "no"


WEIGHTS = (NO, UNKNOWN, CARE, YES)
"""From what weighs most: the answer is the first that some reason has."""


MOST_VIOLATED = 0.5
"""Share of the verdicts violated from which on a model is refused of which nothing shows that it ever holds."""


def reasons(
    model: UncertainLTI, validation: Mapping[str, Any] | None, recordings: Sequence[Mapping[str, Any]]
) -> list[dict[str, str]]:
    """Every reason for and against relying on a model."""
    return [
        *_fit_reasons(model),
        *_stability_reasons(model),
        *_regime_reasons(model, recordings),
        *_validation_reasons(validation, model),
        *_width_reasons(model, recordings),
        *_recording_reasons(model, recordings, validation),
    ]


def answer(found: Sequence[Mapping[str, str]]) -> str:
    """Whether the model may be relied on: the weightiest of its reasons."""
    weights = {YES, *(reason["weight"] for reason in found)}
    return next(weight for weight in WEIGHTS if weight in weights)


def _reason(weight: str, about: str, text: str) -> dict[str, str]:
    return {"weight": weight, "about": about, "text": text}


def _fit_reasons(model: UncertainLTI) -> list[dict[str, str]]:
    messages = [str(message) for message in list_of(model.fit_summary.get("messages"))]
    # widths have a reason of their own below, from the recordings at hand too
    # and so have the blocks of a schedule, together
    apart = ("the bounds are over", "the block at")
    found = [_reason(CARE, "fit", message) for message in messages if not message.startswith(apart)]
    if not model.fit_summary:
        found.append(_reason(CARE, "fit", "the model file does not say how it was fitted"))
    return found


def _stability_reasons(model: UncertainLTI) -> list[dict[str, str]]:
    """A nominal model that multiplies a deviation at every step is no picture of the machine."""
    if model.sampling.dt_median is None or not math.isfinite(radius := model.spectral_radius()) or radius <= RUNS_AWAY:
        return []
    if any("spectral radius" in str(message) for message in list_of(model.fit_summary.get("messages"))):
        return []  # the fit reports it
    text = f"the nominal model runs away: a deviation can grow {number(radius)} times in a step (spectral radius)"
    return [_reason(CARE, "stability", text)]


def _regime_reasons(model: UncertainLTI, recordings: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Regimes with little data, and verdicts in regimes that the model does not know."""
    reasons = [_reason(CARE, "regimes", text) for text in blocks_in_words(model)]
    judged = sum(r["verdicts"] for r in recordings)
    unknown = sum(r["unknown_regime"] for r in recordings)
    if judged and unknown:
        why = "; ".join(dict.fromkeys(text for r in recordings for text in r["unknown"]))
        text = f"{_percent(unknown / judged)} of the verdicts are in regimes that the model does not know: {why}"
        reasons.append(_reason(UNKNOWN if unknown > UNVOUCHED * judged else CARE, "regimes", text))
    elif strange := list(dict.fromkeys(text for r in recordings for text in r["unknown"])):
        reasons.append(_reason(CARE, "regimes", "; ".join(strange)))
    return reasons


def _validation_reasons(validation: Mapping[str, Any] | None, model: UncertainLTI) -> list[dict[str, str]]:
    alarm = model.fit_summary.get("alarm")
    if isinstance(alarm, Mapping) and alarm.get("headline"):
        weight = {"good": YES, "some": CARE}.get(str(alarm.get("worth")), NO)
        promised = "; ".join(map(str, list_of(alarm.get("promises"))))
        found = [_reason(weight, "alarm", f"{alarm['headline']}; {promised}")]
        if validation is not None and validation.get("hint"):
            found.append(_reason(CARE, "validation", validation["hint"]))
        return found
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
    widths = numbers_of(model.fit_summary.get("mean_width"), model.n) or [math.nan] * model.n
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
        armed = isinstance(model.fit_summary.get("alarm"), Mapping)  # a window sees less than what a width says
        return [_reason(NO if 2 * len(useless) >= model.n and not armed else CARE, "tightness", text)]
    worst = max(wide, key=lambda name: wide[name])
    text = f"one-step bounds are at most {wide[worst]:.3g} times as wide as the state's own range {where} "
    return [_reason(CARE if names else YES, "tightness", f"{text}({shortened(worst)})")]


def _recording_reasons(
    model: UncertainLTI, recordings: Sequence[Mapping[str, Any]], validation: Mapping[str, Any] | None
) -> list[dict[str, str]]:
    found = []
    fitted = {s.get("sha256") for s in list_of(model.fit_summary.get("sources")) if isinstance(s, Mapping)} - {None, ""}
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


def _percent(share: float) -> str:
    """Never 100 % of what is not all."""
    text = f"{100 * share:.2f}"
    if text == "100.00" and share < 1.0:
        text = "over 99.99"
    return f"{text} %"
