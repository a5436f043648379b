"""Validation: how a fitted envelope does on recordings, or parts of one, that were left out of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.html_table import html_table, name_with_unit, number_text
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.identification import fit
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.blocks import BLOCKS, block_spans, cut, guard_interval, remaining_spans
from uncertain_lti.validation.false_alarms import false_alarms
from uncertain_lti.validation.groups import likely_groups, resolve_groups
from uncertain_lti.validation.intervals import (
    rate_interval,
    share_interval,
)
from uncertain_lti.validation.part import Part, by_unit, judge, unit_numbers
from uncertain_lti.validation.scenario import scenario

LIMIT = 1e9
"""Elements of all left-out problems together up to which a fit leaves out as well: some minutes."""
REFERENCE_RULES = ((1, 1), (2, 3), (3, 5))
"""Alarm rules whose false alarms are counted beside the model's own."""


@dataclass(frozen=True, repr=False)
class Validation:
    """What `validate` found.

    Parameters
    ----------
    model : UncertainLTI
        The fit to all recordings.
    parts : tuple of Part
        What was left out, one after the other.
    kind : str
        `transients` or `blocks`.
    gap : float
        Time on both sides of a left-out block that was not fitted either, s; 0 for transients.
    confidence : float
        Of every interval.
    grouping : str
        In words, what the groups are that were left out as a whole; "" if every part was left out alone.
    hint : str
        A sentence if the recordings seem to come in groups and none were given, else "".
    """

    model: UncertainLTI
    parts: tuple[Part, ...]
    kind: str
    gap: float
    confidence: float
    grouping: str = ""
    hint: str = ""

    @property
    def what(self) -> str:
        """What was left out at a time, and what every interval takes for independent: recording, block or group."""
        return "group" if self.grouping else "recording" if self.kind == "transients" else "block"

    @property
    def units(self) -> int:
        """How many of them there are."""
        return int(unit_numbers(self.parts).max(initial=-1)) + 1

    def __repr__(self) -> str:
        judged, violated = sum(p.judged for p in self.parts), sum(p.violated for p in self.parts)
        inside = f"{1 - violated / judged:.3%} of {plural(judged, 'verdict')} inside" if judged else "no verdict"
        whole = int(np.count_nonzero(by_unit(self.parts, [p.violated for p in self.parts]) == 0))
        of = "groups" if self.grouping else self.kind
        return f"Validation(left out one of {self.units} {of}: {inside}, {whole} whole)"

    def _repr_html_(self) -> str:
        """Coverage beside widths, from `Validation.to_dict()`."""
        data = self.to_dict()
        rows = [
            [
                name_with_unit(name, s["unit"]),
                "–" if s["inside"] is None else f"{s['inside']:.3%}",
                f"{s['parts_inside']}/{data['parts']}",
                number_text(s["mean_width_left_out"]),
                number_text(s["mean_width_full"]),
            ]
            for name, s in data["states"].items()
        ]
        below = []
        if data["inside"] is not None:
            low, high = data["inside_interval"]
            below.append(
                f"inside all bounds: {data['inside']:.3%} of {plural(data['verdicts'], 'verdict')} "
                f"({data['confidence']:.0%} interval {low:.3%} to {high:.3%})"
            )
        for rule in data["false_alarms"][:1]:
            of = f"{rule['violations']} of {rule['window']}"
            below.append(f"false alarms per hour at {of}: {number_text(rule['per_hour'])}")
        below += [data["scenario"]["words"], *(f"note: {note}" for note in data["notes"])]
        return html_table(repr(self), ("left out", "inside", "whole parts", "mean width", "fitted"), rows, below)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: coverage beside widths, false alarms per hour with intervals, scenario bound in words.

        Returns
        -------
        dict
            As `summary`.
        """
        return summary(self)


def validate(
    transients: Sequence[Transient] | Transient,
    *,
    operating_point: OperatingPoint | None = None,
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    alarm_rule: AlarmRule | None = None,
    blocks: int | None = None,
    gap: float | None = None,
    groups: Sequence[Any] | str | None = None,
    confidence: float = 0.9,
    full: UncertainLTI | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Validation:
    """Leave out one recording or group at a time, fit to the others, and judge what was left out.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        The recordings.
    operating_point : OperatingPoint, optional
        As in `fit`.
    weights : array or sequence of array, optional
        As in `fit`; weights per sample go with their samples.
    alarm_rule : AlarmRule, optional
        As in `fit`.
    blocks : int, optional
        Cut every recording into so many contiguous blocks and leave out one block at a time. Default: whole recordings
        where there are two or more, else BLOCKS blocks.
    gap : float, optional
        Time on both sides of a left-out block that is not fitted either, s, because it resembles the block. Default:
        three times the slowest time constant of the nominal model, at most half a block.
    groups : sequence or str, optional
        What the recordings have in common: one name (of a machine, a day, an operator) per recording, or a key of
        `groups.group_names`. A whole group is left out at a time, and the intervals count groups. Without it they
        take every recording for independent of the others.
    confidence : float, default 0.9
        Of every interval, 0.5 to below 1.
    full : UncertainLTI, optional
        The fit to all recordings, where it is there already.
    progress : callable, optional
        Called with one line of text per fit.
    **options : object
        Further arguments of `fit`.

    Returns
    -------
    Validation
        The parts, each judged by the model that was fitted without it.

    Raises
    ------
    FitError
        There is too little to leave out, an option is out of range, or a left-out fit fails (names the part).
    """
    transients = [transients] if isinstance(transients, Transient) else list(transients)
    if not 0.5 <= confidence < 1.0:
        raise FitError(f"confidence is {confidence:g}; it must be at least 0.5 and below 1")
    if blocks is not None and blocks < 2:
        raise FitError(f"blocks is {blocks}; at least 2 are needed to leave one out")
    if full is None:
        full = fit(transients, weights=weights, operating_point=operating_point, alarm_rule=alarm_rule, **options)
    elif alarm_rule is not None:
        full = full.replace(alarm_rule=alarm_rule)
    if groups is not None and blocks is not None:
        raise FitError("groups leave out whole recordings, and blocks cut them; choose one")
    names, grouping = resolve_groups(transients, groups)
    if blocks is None and len(transients) == 1:
        blocks = BLOCKS
    if blocks is None:
        if gap is not None:
            raise FitError("gap is given and whole recordings are left out; it goes with blocks")
        cuts = [(t, 0, len(t)) for t in transients]
        gap = 0.0
    else:
        if gap is not None and not (math.isfinite(gap) and gap >= 0):
            raise FitError(f"gap is {gap}; it must be 0 s or more")
        cuts = [(t, *span) for t in transients for span in block_spans(t, blocks)]
        gap = guard_interval(full, cuts) if gap is None else gap
    parts: dict[int, Part] = {}
    own = _split_weights(weights, transients, full.n)
    units: dict[Any, list[int]] = {}
    for i in range(len(cuts)):
        units.setdefault(names[i] if grouping else i, []).append(i)
    for number, (unit, together) in enumerate(units.items()):
        left, start, stop = cuts[together[0]]
        name = left.name if blocks is None else f"{left.name} from {left.t[start]:.6g} to {left.t[stop - 1]:.6g} s"
        name = f"group {unit}" if grouping else name
        if progress is not None:
            progress(CountedStep(f"fit {number + 1} of {len(units)}: without {name}", number + 1, len(units)))
        absent = {id(cuts[i][0]): cuts[i][1:] for i in together}
        pieces, kept = [], []
        for transient, weight in zip(transients, own, strict=True):
            whole = (0, len(transient))
            gone = absent.get(id(transient))
            for a, b in [whole] if gone is None else remaining_spans(transient, *gone, gap):
                if b - a >= 2:
                    pieces.append(transient if (a, b) == whole else cut(transient, a, b))
                    kept.append(None if weight is None else weight[a : b - 1])
        chosen = kept if own[0] is not None else weights
        try:
            model = fit(pieces, weights=chosen, operating_point=full.operating_point, describe_data=False, **options)  # type: ignore[arg-type]
        except FitError as error:
            raise FitError(f"without {name} no model can be fitted: {error}") from None
        for i in together:
            left, start, stop = cuts[i]
            tested = left if (start, stop) == (0, len(left)) else cut(left, start, stop)
            parts[i] = judge(model, full, tested, left.name if grouping else name, names[i] if grouping else "")
    kind = "transients" if blocks is None else "blocks"
    hint = "" if grouping or blocks is not None else likely_groups(transients)
    return Validation(full, tuple(parts[i] for i in sorted(parts)), kind, float(gap), confidence, grouping, hint)


def _split_weights(
    weights: ArrayLike | Sequence[ArrayLike] | None, transients: Sequence[Transient], n: int
) -> list[Array | None]:
    """Weights per step of each transient; None where they are the same in every step."""
    if weights is None:
        return [None] * len(transients)
    if isinstance(weights, (list, tuple)) and all(np.ndim(w) >= 2 for w in weights):
        return [np.asarray(w, dtype=np.float64) for w in weights]
    stacked = np.asarray(weights, dtype=np.float64)
    if stacked.ndim == 1 and stacked.shape == (n,):
        return [None] * len(transients)
    lengths = np.cumsum([max(len(t) - 1, 0) for t in transients])
    return list(np.split(stacked, lengths[:-1]))


# --- what it means ------------------------------------------------------------------------------------------


def summary(validation: Validation) -> dict[str, Any]:
    """Everything `validate` found as plain data; the fields are described in docs/validation.md.

    Parameters
    ----------
    validation : Validation
        Of `validate`.

    Returns
    -------
    dict
        Plain data for JSON; widths in recorded units.
    """
    v, model, parts = validation, validation.model, validation.parts
    judged = sum(p.judged for p in parts)
    hours = sum(p.hours for p in parts)
    violated = [p.violated for p in parts]
    inside = sum(p.violated == 0 for p in parts)
    held_width = _average(parts, [p.mean_width for p in parts])
    full_mean, full_max = full_widths(model)
    states = {}
    for i, name in enumerate(model.state_names):
        bad = sum(int(p.violations[i]) for p in parts)
        states[name] = {
            "inside": 1.0 - bad / judged if judged else None,
            "parts_inside": sum(int(p.violations[i]) == 0 for p in parts),
            "mean_width_left_out": float(held_width[i]),
            "max_width_left_out": float(np.nanmax([p.max_width[i] for p in parts])),
            "mean_width_full": full_mean[i],
            "max_width_full": full_max[i],
            "left_out_to_full": float(_average(parts, [p.relative_width for p in parts])[i]),
            "unit": model.signals.states[i].unit,
        }
    units = by_unit(parts, violated)
    low, high = rate_interval(units, judged, v.confidence) if judged else (0.0, math.inf)
    rules = [model.alarm_rule, *(AlarmRule(m, n, model.alarm_rule.margin) for m, n in REFERENCE_RULES)]
    alarms = [false_alarms(parts, rule, v.confidence) for rule in dict.fromkeys(rules)]
    return {
        "kind": v.kind,
        "parts": len(parts),
        "gap": v.gap,
        "confidence": v.confidence,
        "verdicts": judged,
        "hours": hours,
        "inside": 1.0 - sum(violated) / judged if judged else None,
        "inside_interval": [max(0.0, 1.0 - high), 1.0 - low],
        "parts_inside": inside,
        "parts_inside_share": inside / len(parts),
        "parts_inside_interval": _whole_interval(v),
        "groups": None
        if not v.grouping
        else {
            "key": v.grouping,
            "count": v.units,
            "inside": int(np.count_nonzero(units == 0)),
            "recordings": {p.group: [q.name for q in parts if q.group == p.group] for p in parts},
        },
        "condition": condition(v),
        "condition_short": short_condition(v),
        "hint": v.hint,
        "outside_domain": sum(p.outside_domain for p in parts),
        "violated_inside_domain": sum(p.unseen for p in parts),
        "states": states,
        "false_alarms": alarms,
        "scenario": scenario(model, parts, v.what, v.confidence),
        "part": [
            {"name": p.name, "verdicts": p.judged, "violated": p.violated, "outside_domain": p.outside_domain}
            for p in parts
        ],
        "notes": _notes(v),
    }


def short_condition(validation: Validation) -> str:
    """What must be true for the intervals to hold, in a few words.

    Parameters
    ----------
    validation : Validation
        Of `validate`.

    Returns
    -------
    str
        A clause to stand beside an interval.
    """
    return f"if the {validation.what}s are independent"


def condition(validation: Validation) -> str:
    """What must be true for the intervals to hold.

    Parameters
    ----------
    validation : Validation
        Of `validate`.

    Returns
    -------
    str
        A sentence.
    """
    v = validation
    if v.kind == "blocks":
        return (
            f"every interval counts {plural(v.units, 'block')}, and holds for more of the same runs if the blocks are "
            f"independent of one another; of another day, machine or operator it says nothing"
        )
    alike = "" if v.grouping else ", machines or operators"
    return (
        f"every interval counts {plural(v.units, v.what)}, and holds if they are independent of one another and the "
        f"machine is run like that again: no other days{alike} that differ by more than these do, no wear, no kind of "
        f"event that none of them shows"
    )


def _whole_interval(validation: Validation) -> list[float]:
    """For the share of whole parts inside all bounds: exact of independent parts, by clusters of groups."""
    v, parts = validation, validation.parts
    left = [p.violated > 0 for p in parts]
    if not v.grouping:
        return list(share_interval(len(parts) - sum(left), len(parts), v.confidence))
    low, high = rate_interval(by_unit(parts, left), len(parts), v.confidence)
    return [max(0.0, 1.0 - high), 1.0 - low]


def full_widths(model: UncertainLTI) -> tuple[list[float], list[float]]:
    """Widths of the full fit on its own samples.

    Parameters
    ----------
    model : UncertainLTI
        Of `fit`.

    Returns
    -------
    list of float
        Mean width of each state, recorded units.
    list of float
        Largest width of each state, recorded units.
    """
    return (
        [float(w) for w in model.fit_summary["mean_width_recorded"]],
        [float(w) for w in model.fit_summary["max_width_recorded"]],
    )


def _average(parts: Sequence[Part], values: Sequence[Array]) -> Array:
    """Mean over parts by their verdicts, (n,)."""
    weight = np.array([p.judged for p in parts], dtype=np.float64)
    stacked = np.array(values)
    used = weight > 0
    if not used.any():
        return np.full(stacked.shape[1], np.nan)
    return np.asarray(weight[used] @ stacked[used] / weight[used].sum())


def _notes(validation: Validation) -> list[str]:
    v = validation
    G, what = v.units, f"{v.what}s"
    notes = [
        f"the numbers are those of models fitted to {G - 1} of the {G} {what}: the model of all {G} is a little "
        f"better, so they err on the safe side"
    ]
    if v.hint:
        notes.insert(0, v.hint)
    if G < 6:
        notes.append(f"{G} {what} say little: an interval from so few is wide, and rests on them being typical")
    if count := len(v.model.fit_summary.get("discarded", [])):
        notes.append(
            f"every left-out fit may discard {count} transitions as well; in what is left out nothing is discarded, so "
            f"outliers there count as violations"
        )
    if v.kind == "blocks":
        notes.append(
            "blocks show how the model does on the same run at another time; another run, load or day can differ by "
            "more than blocks of one run do: record several"
        )
    left = sum(p.outside_domain for p in v.parts)
    judged = sum(p.judged for p in v.parts)
    if judged and left > 0.01 * judged:
        notes.append(
            f"{left / judged:.1%} of the left-out verdicts lie outside the domain fitted without them, so the "
            f"{what} do not repeat one another: nothing fitted vouches for the bounds there"
        )
    return notes


def validate_model(
    model: UncertainLTI,
    transients: Sequence[Transient],
    *,
    blocks: int | None = None,
    gap: float | None = None,
    groups: Sequence[Any] | str | None = None,
    confidence: float = 0.9,
    progress: Callable[[str], None] | None = None,
) -> Validation:
    """Validate a fitted model, or one from a file, with the recordings it was fitted to and the options it names.

    The key by which its file says that the recordings are grouped, `fit --group`, counts unless groups or blocks are
    given.

    Parameters
    ----------
    model : UncertainLTI
        Of `fit`, with its summary.
    transients : sequence of Transient
        The recordings it was fitted to.
    blocks : int, optional
        As in `validate`.
    gap : float, optional
        As in `validate`.
    groups : sequence or str, optional
        As in `validate`; "none" leaves out single recordings all the same.
    confidence : float, default 0.9
        As in `validate`.
    progress : callable, optional
        As in `validate`.

    Returns
    -------
    Validation
        As of `validate`.

    Raises
    ------
    FitError
        Beside those of `validate`: the model does not say how it was fitted, or the recordings do not give it again.
    """
    if isinstance(groups, str) and groups == "none":
        groups = None
    elif groups is None and blocks is None:
        groups = model.fit_summary.get("group")
    if progress is not None:
        progress("the fit to all recordings")
    again = fit(transients, operating_point=model.operating_point, **_options(model))
    if not _same(again, model):
        raise FitError(
            "these recordings do not give this model again, so what was left out of them would say nothing of it; "
            "name the recordings it was fitted to, or fit it anew"
        )
    return validate(
        transients,
        operating_point=model.operating_point,
        alarm_rule=model.alarm_rule,
        blocks=blocks,
        gap=gap,
        groups=groups,
        confidence=confidence,
        full=again,
        progress=progress,
        **_options(model),
    )


def _options(model: UncertainLTI) -> Mapping[str, Any]:
    """Options of `fit` that a model says it was fitted with; see `validate_model`."""
    facts = model.fit_summary
    for key in ("criterion", "additive"):
        if key not in facts:
            raise FitError(f"the model does not say by which {key} it was fitted; fit it again")
    if facts.get("weights", "ones") != "ones":
        raise FitError("the model was fitted with weights, which its file does not hold; use validate() from Python")
    options: dict[str, Any] = {"criterion": facts["criterion"], "additive": facts["additive"]}
    options |= {key: facts[key] for key in ("discard", "count") if key in facts}
    if "structure" in facts:
        options["structure"] = Structure.from_dict(facts["structure"], model.n, model.m)
    return options


def _same(one: UncertainLTI, other: UncertainLTI) -> bool:
    """The same widths from as many transitions; another numpy may round otherwise, so not to the bit."""
    if one.fit_summary["transitions"] != other.fit_summary.get("transitions"):
        return False
    return np.allclose(one.fit_summary["mean_width"], np.asarray(other.fit_summary["mean_width"]), rtol=1e-6, atol=0.0)


def leave_out_with_fit(
    transients: Sequence[Transient],
    model: UncertainLTI,
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    limit: float = LIMIT,
) -> dict[str, Any]:
    """The summary of `validate` for a model that was just fitted, or `{"not_done": why}`.

    Whether it is done depends on the recordings and the model alone, never on how long anything took: it is done
    if the elements of all left-out problems together (fits, transitions, states, signals) are at most `limit`.

    Parameters
    ----------
    transients : sequence of Transient
        The recordings.
    model : UncertainLTI
        Fitted to them.
    groups : sequence or str, optional
        As in `validate`.
    progress : callable, optional
        Called with one line of text per fit.
    limit : float, default LIMIT
        Elements of all left-out problems together.

    Returns
    -------
    dict
        As `summary`, or with the key `not_done` alone.

    Raises
    ------
    FitError
        The groups do not fit the recordings.
    """
    names, _ = resolve_groups(transients, groups)
    fits = len(set(names)) if names else len(transients) if len(transients) > 1 else BLOCKS
    size = float(model.fit_summary["transitions"]) * model.n * (model.n + model.m)
    if fits * size > limit:
        return {
            "not_done": f"it takes {fits} fits of a problem as large as this one ({size:.2g} elements each); run "
            f"uncertain-lti validate"
        }
    if model.fit_summary.get("weights", "ones") != "ones":
        return {"not_done": "the weights belong to the samples; use validate() from Python"}
    try:
        return validate(
            transients,
            operating_point=model.operating_point,
            alarm_rule=model.alarm_rule,
            groups=groups,
            full=model,
            progress=progress,
            **_options(model),
        ).to_dict()
    except FitError as error:  # too little is left when a part is left out: the fit itself stands
        return {"not_done": str(error)}
