# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The model file: its structure, and how it is read and written."""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from uncertain_lti.base.arrays import LONGEST_S, Array
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.files import kind_of, written
from uncertain_lti.base.text import finite_data, list_of, plural, shortlist
from uncertain_lti.model.alarm_rule import CONTAINMENT, AlarmRule, Rule, checked_rules, rule_from_dict
from uncertain_lti.model.domain import Domain, Occupancy, Sampling
from uncertain_lti.model.horizon import Horizon, Residuals, Run
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import BlockData, Schedule
from uncertain_lti.model.signature import Signature
from uncertain_lti.model.terms import ARRAYS, REQUIRED, blocks_of, checked, is_number, is_whole, object_of
from uncertain_lti.signals.signal_map import Signal, SignalMap
from uncertain_lti.signals.values import TableLayout

FORMATS = ("uncertain-lti/1", "uncertain-lti/2")
"""Formats of model files, oldest first; the oldest that holds a model is written."""
MAX_FILE_BYTES = 64 * 2**20
_IN_EVERY_FILE = ("A", "B", "dA", "dB", "c", "dc", "v")  # the arrays of format 1; others are written if they are not 0
_STATE = ("name", "topic", "type", "field", "unit", "steady", "scale")
_SCHEDULING = (*_STATE, "max_hold")
_CONTROL = (*_SCHEDULING, "delay")
_STEPS = ("dt_median", "dt_min", "dt_max")
_SAMPLING = {"clock", "clock_type", "time", *_STEPS, "max_gap", "min_step", "max_skew"}
_NEWER = {"schedule", "scheduling", "blocks", "horizons", "run", "residuals", "frozen", "signatures", "memory"}
_OF_DOMAIN = ("measure", "step_max", "anywhere")  # what files of format 1 lack
_IN_FILES = {"optimality_gap": "gap"}  # keys of the fit that files of format 1 call otherwise
_IN_PYTHON = {name: key for key, name in _IN_FILES.items()}


def structure(model: Any) -> dict[str, Any]:
    """The structure of a model file, in the oldest format that holds the model."""
    signals, sampling, domain, rule = model.signals, model.sampling, model.domain, model.alarm_rule
    arrays = [name for name in ARRAYS if name in _IN_EVERY_FILE or getattr(model, name).any()]
    regimes = {name: getattr(model, name).tolist() for name in arrays}
    if model.schedule is not None:
        each = zip(model.blocks_to_list(arrays), model.block_data, strict=True)
        regimes = {
            "schedule": model.schedule.to_list(),
            "scheduling": [_signal(s, _SCHEDULING) for s in signals.scheduling] or None,
            "blocks": [b | {"transitions": f.transitions, "tied_to": f.tied_to} for b, f in each],
        }
    said = {
        "clock": signals.clock or "",
        "clock_type": next((s.type for s in signals.states if s.topic == signals.clock), ""),
        "time": dict(signals.time),
        **asdict(sampling),
        **{name: getattr(signals, name) for name in ("max_gap", "min_step", "max_skew")},
        "step": None if isinstance(signals.step, str) else signals.step,
        "table": _dict(signals.table),
    }
    box = {name: getattr(domain, name) for name in ("x_min", "x_max", "u_min", "u_max")}
    found = {"measure": _dict(domain.measure), "step_max": finite_data(domain.step_max), "anywhere": domain.anywhere}
    whole = {
        "format": FORMATS[0],
        "states": [_signal(s, _STATE) for s in signals.states],
        "controls": [_signal(s, _CONTROL) for s in signals.controls],
        "sampling": _known(said, ("step", "table")),
        **regimes,
        "horizons": [horizon.to_dict() for horizon in model.horizons] or None,
        "run": _dict(model.run),
        "domain": finite_data(box) | _known(found, _OF_DOMAIN),
        "residuals": _dict(model.residuals),
        "alarm": {key: getattr(rule, key) for key in ("violations", "window", "margin")}
        if model.alarm == (rule,)
        else {"rules": [rule.to_dict() for rule in model.alarm]},
        "frozen": _dict(model.repeats),
        "signatures": [signature.to_dict() for signature in model.signatures] or None,
        "fit": finite_data({_IN_FILES.get(key, key): value for key, value in model.fit_summary.items()}),
        "validation": finite_data(model.validation),
        "memory": model.memory or None,
    }
    whole = _known(whole, whole)
    newer = (
        *(whole.keys() & _NEWER, signals.arrivals, "rules" in whole["alarm"], len(arrays) > len(_IN_EVERY_FILE)),
        *(whole["sampling"].keys() & {"step", "table"}, whole["domain"].keys() & set(_OF_DOMAIN)),
        *(g.memory or g.valid is not None or g.ignore or g.judged for g in signals),
    )
    return whole | {"format": FORMATS[any(newer)]}


def _known(entries: dict[str, Any], which: Collection[str]) -> dict[str, Any]:
    """Without those of these entries that are None."""
    return {name: value for name, value in entries.items() if value is not None or name not in which}


def _dict(part: Any) -> Any:
    """A part of a model as it is in the file; None for none."""
    return None if part is None else part.to_dict()


def _signal(signal: Signal, keys: Sequence[str]) -> dict[str, Any]:
    """Entry of a signal; null for no limit of what is valid."""
    entry: dict[str, Any] = {key: getattr(signal, key) for key in keys}
    if signal.valid is not None:
        entry["valid"] = finite_data(signal.valid)
    if signal.at != "departure":
        entry["at"] = signal.at
    if signal.judged:
        entry |= {"judged": True, "max_hold": signal.max_hold}
    if signal.ignore:
        entry["ignore"] = [v if math.isfinite(v) else str(v) for v in signal.ignore]
    return entry


def arguments(data: Any, source: str) -> dict[str, Any]:
    """What a model is made of, from the structure of its file."""
    if not isinstance(data, dict) or "format" not in data:
        raise ModelError(f"no field 'format'; is this a model file written by `uncertain-lti fit` ({FORMATS[0]})?")
    if data["format"] not in FORMATS:
        raise ModelError(
            f"format is {reprlib.repr(data['format'])}, and this version reads {', '.join(FORMATS)}; fit the model "
            f"again, or use the version that wrote it"
        )
    newer = data["format"] != FORMATS[0]
    scheduled = newer and "schedule" in data
    known = {"format", "states", "controls", "sampling", "domain", "alarm", "fit", "validation"}
    regimes = {"schedule", "scheduling", "blocks"}
    known |= (regimes if scheduled else set(ARRAYS)) | (_NEWER - regimes if newer else set())
    object_of(data, "", known, needed=("states", "controls", "sampling", *(("blocks",) if scheduled else REQUIRED)))
    said = object_of(data["sampling"], "sampling", {*_SAMPLING, "step", "table"} if newer else _SAMPLING)
    steps = {key: _positive(said.get(key), f"sampling.{key}") for key in (*_STEPS, "max_gap", "max_skew", "step")}
    _text(said.get("clock_type", ""), "sampling.clock_type")
    time = object_of(said.get("time", {}), "sampling.time")
    for topic, kind in time.items():
        if _text(kind, f"sampling.time[{topic}]") not in ("header", "log"):
            raise ModelError(f"sampling.time[{topic}] is {reprlib.repr(kind)}; it must be header or log")
    listed = {key: data.get(key) for key in ("states", "controls", "scheduling")}
    signals = replace(
        SignalMap.from_dict(listed, source=source, need_topics=False),
        clock=_text(said.get("clock", ""), "sampling.clock") or None,
        max_gap=steps["max_gap"],
        min_step=_positive(said.get("min_step", 0.0), "sampling.min_step", zero=True) or 0.0,
        max_skew=steps["max_skew"],
        step=steps["step"] or "recorded",
        time=time,
        table=TableLayout.from_dict(said["table"], "sampling.table") if "table" in said else None,
    )
    n, m = len(signals.states), len(signals.controls)
    arrays, regime_data = _blocks(data, n, m) if scheduled else ({name: data.get(name) for name in ARRAYS}, {})
    if not scheduled:
        checked(data["A"], "A", (n, n))  # against the names, before A says how many rows the others have
        checked(data["B"], "B", (n, m))
    blocks = regime_data["schedule"].blocks if scheduled else None
    return {
        **arrays,
        **regime_data,
        "horizons": Horizon.list_from(data["horizons"], n, m, blocks) if "horizons" in data else (),
        "run": Run.from_dict(data["run"], n, m, blocks) if "run" in data else None,
        "signals": signals,
        "sampling": Sampling(**{key: steps[key] for key in _STEPS}),
        "domain": _domain(data["domain"], n, m, newer) if "domain" in data else None,
        "alarm": _alarm(data.get("alarm", {}), newer),
        "residuals": Residuals.from_dict(data["residuals"]) if "residuals" in data else None,
        "signatures": Signature.list_from(data.get("signatures", [])),
        "repeats": Repeats.from_dict(data["frozen"]) if data.get("frozen") is not None else None,
        "fit_summary": {_IN_PYTHON.get(k, k): v for k, v in object_of(data.get("fit", {}), "fit").items()},
        "validation": object_of(data.get("validation", {}), "validation"),
        "memory": object_of(data.get("memory", {}), "memory"),
    }


def _domain(data: Any, n: int, m: int, newer: bool) -> Domain:
    sizes = {"x_min": n, "x_max": n, "u_min": m, "u_max": m}
    also = set(_OF_DOMAIN) if newer else set()
    box = object_of(data, "domain", set(sizes) | also, sizes)
    limits = {name: _limits(box[name], f"domain.{name}", size) for name, size in sizes.items()}
    measure, step_max, anywhere = (box.get(name) for name in _OF_DOMAIN)
    flags = [type(each) for each in anywhere] if isinstance(anywhere, list) else None
    if anywhere is not None and flags != [bool] * (n + m):
        raise ModelError(f"field 'domain.anywhere' must be a list of {n + m} of true and false")
    if step_max is not None and ((step_max := checked(step_max, "domain.step_max", (n,))) < 0.0).any():
        raise ModelError("field 'domain.step_max' holds a negative number")
    seen = None if measure is None else Occupancy.from_dict(measure, n + m)
    return Domain(**limits, measure=seen, step_max=step_max, anywhere=anywhere)


def _alarm(data: Any, newer: bool) -> tuple[Rule, ...]:
    """Rules of the alarm: a list of them, or the one of format 1."""
    if newer and isinstance(data, dict) and "rules" in data:
        rules = object_of(data, "alarm", {"rules"})["rules"]
        if not isinstance(rules, list):
            raise ModelError("field 'alarm.rules' must be a list of rules")
        return checked_rules([rule_from_dict(rule, f"alarm.rules[{i}]") for i, rule in enumerate(rules)])
    return (AlarmRule(**object_of(data, "alarm", {"violations", "window", "margin"})),)


def _blocks(data: dict[str, Any], n: int, m: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays, and schedule and data of the blocks, of a scheduled model."""
    schedule = Schedule.from_list(data["schedule"])
    arrays = blocks_of(data["blocks"], "blocks", n, m, schedule.blocks, also=("transitions", "tied_to"))
    facts = []
    for r, block in enumerate(data["blocks"]):
        for name, most in (("transitions", math.inf), ("tied_to", schedule.blocks - 1)):
            value = block.get(name)
            if value is not None and not (is_whole(value) and 0 <= value <= most):
                raise ModelError(f"field 'blocks[{r}].{name}' is {reprlib.repr(value)}; it must be a whole number")
        facts.append(BlockData(block.get("transitions"), block.get("tied_to")))
    return arrays, {"schedule": schedule, "block_data": facts}


def write(path: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write a model file; an existing file is replaced as a whole or not at all."""
    refuse_other(path, (str, os.PathLike), "the model file", "give its path", ModelError)
    try:
        text = _layout(data).encode()
    except (TypeError, ValueError, RecursionError) as error:
        named = isinstance(error, UnicodeEncodeError)
        remedy = "rename the recording whose name is not UTF-8" if named else "mend its fit or validation"
        raise ModelError(f"{path}: the model holds what JSON cannot ({error}); {remedy}") from None
    with written(path, ModelError) as stream:
        stream.write(text)


def read(path: str | os.PathLike[str]) -> Any:
    """Read the structure of a model file."""
    refuse_other(path, (str, os.PathLike), "the model file", "give its path", ModelError)
    if (kind := kind_of(path)) and kind != "a model file":
        cures = {"a folder": "name the file in it", "a signals file": "write a model with `uncertain-lti fit`"}
        cures["a pipe or a device"] = "write it to a file first"
        cure = cures.get(kind, "are the arguments swapped?")
        raise ModelError(f"{path}: this is {kind}, and a model file is wanted here; {cure}")
    try:
        if os.path.getsize(path) > MAX_FILE_BYTES:
            raise ModelError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, so not a model file; check the path")
        with open(path, encoding="utf-8-sig") as stream:
            return json.load(stream, object_pairs_hook=_distinct)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such model file; write one with `uncertain-lti fit`") from None
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}; check the path") from None
    except (ValueError, RecursionError) as error:
        detail = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise ModelError(f"{path}: is not JSON ({detail}); write one with `uncertain-lti fit`") from None


def sources_of(model: Any) -> list[dict[str, str]]:
    """`file` and `sha256` of what a model was fitted to, "" for what its file does not say; anything may be in it."""
    sources = (source for source in list_of(model.fit_summary.get("sources")) if isinstance(source, Mapping))
    return [{key: str(source.get(key) or "") for key in ("file", "sha256")} for source in sources]


def read_rules(path: str | os.PathLike[str], states: Sequence[str]) -> tuple[Rule, ...]:
    """Read the rules of an alarm from a file, for a model of these states."""
    data = whole = read(path)
    if isinstance(data, dict):
        data = data.get("alarm", data)
    try:
        if not (isinstance(data, dict) and data.keys() & {"rules", "violations", "window", "margin"}):
            raise ModelError("no rules of an alarm; give a model file, or JSON as its field 'alarm' has it")
        rules = _alarm(data, newer=True)
        listed = whole.get("states")
        own = [str(s.get("name")) for s in listed if isinstance(s, dict)] if isinstance(listed, list) else []
        if own not in ([], list(states)) and any(rule.kind != CONTAINMENT for rule in rules):
            raise ModelError(
                f"its thresholds are of the states {shortlist(own, 5)}, and the model has {shortlist(states, 5)}; take "
                f"the rules of a model of the same states in the same order"
            )
        return rules
    except ModelError as error:
        raise ModelError(f"{os.fspath(path)}: {error}") from None


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise ModelError(f"field '{name}' is {reprlib.repr(value)}; it must be a text")
    return value


def _positive(value: Any, name: str, zero: bool = False) -> float | None:
    """A number of seconds that is positive, or not negative where zero is allowed; None for null."""
    if value is None:
        return None
    number = float(value) if is_number(value) else math.nan
    if not (0.0 < number <= LONGEST_S or (zero and number == 0.0)):
        limit = f", at most {LONGEST_S:g}" if number > LONGEST_S else ""
        raise ModelError(f"field '{name}' is {reprlib.repr(value)}; it must be a positive number{limit}")
    return number


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of a JSON file; readers would keep the last of two equal keys."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(k for k in keys if keys.count(k) > 1)!r} stands twice in one object")
    return found


def _limits(value: Any, name: str, size: int) -> Array:
    """A list of numbers; null stands for no limit."""
    if not isinstance(value, list) or len(value) != size:
        raise ModelError(f"field '{name}' must be a list of {plural(size, 'number')}")
    without = -math.inf if name.endswith("min") else math.inf
    limits = checked([0.0 if v is None else v for v in value], name, (size,))
    limits[[v is None for v in value]] = without
    return limits


def _layout(data: Mapping[str, Any]) -> str:
    """JSON with one line per matrix row, signal and entry, so that a diff can be read."""

    def flat(value: Any) -> str:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)

    lines = []
    for key, value in data.items():
        if isinstance(value, list) and value and isinstance(value[0], (list, dict)):
            inner = ",\n    ".join(flat(row) for row in value)
            lines.append(f"  {flat(key)}: [\n    {inner}\n  ]")
        elif isinstance(value, dict) and value:
            inner = ",\n    ".join(f"{flat(k)}: {flat(v)}" for k, v in value.items())
            lines.append(f"  {flat(key)}: {{\n    {inner}\n  }}")
        else:
            lines.append(f"  {flat(key)}: {flat(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"
