# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The proposed signals file: YAML with the reasons as comments."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count, zip_longest
from types import MappingProxyType

import numpy as np

from uncertain_lti.base.arrays import LARGEST, Array
from uncertain_lti.base.errors import TransientError
from uncertain_lti.base.text import printable, shortlist
from uncertain_lti.proposal.candidates import (
    FEWEST,
    OF_QUATERNION,
    SHOWS,
    Candidate,
    Source,
    Steps,
    clock_of,
    earlier,
    held,
    steps_of,
)
from uncertain_lti.proposal.tune import Remembered, choose_memories
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.sampling.clock import coarse_ns, even_ns, longest_pause
from uncertain_lti.sampling.reading import of_another_clock
from uncertain_lti.sampling.steady_state import resolve_auto
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.field_path import FUNCTIONS, FieldPath, Memory
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti.signals.values import CHOICES_TEXT, TableLayout, of_table

_PARTS = re.compile(r"[A-Z]+(?![^\W\d_A-Z])|[A-Z]?[^\W\d_A-Z]+|\d+")  # letters of any alphabet


_DULL = {"pose", "twist", "vector", "data", "point", "transform", "msg", "value", "quaternion", "accel", "wrench"}


_COMPASS = re.compile(r"(?i)(heading|hdg|azimuth|compass)(_?deg\w*)?(?!\w)")
"""Name of the direction in which a vehicle is: nothing depends on it, and another drive may go elsewhere."""
_COURSE = re.compile(r"(?i)(heading|hdg|azimuth|compass|course|yaw)(?!_?rate)")  # of a command: what holds it
_WHEEL = re.compile(r"(^|_)(ticks?|enc(oders?)?)(_|$)(?!.*(vel|speed|rpm|rate|per|volt|temp|current))")


_UNITS = (
    *((re.compile(rf"{name}\("), function.unit) for name, function in FUNCTIONS.items() if function.unit),
    (re.compile(r"angular_velocity\.|twist\.angular\.|(^|\.)angular\.[xyz]$"), "rad/s"),
    (re.compile(r"linear_acceleration\."), "m/s^2"),
    (re.compile(r"(^|\.)linear\.[xyz]$"), "m/s"),
    (re.compile(r"pose\.position\.|translation\."), "m"),
    (re.compile(r"fluid_pressure$"), "Pa"),
)


def name_signals(states: Sequence[Candidate], controls: Sequence[Candidate]) -> None:
    """Give every signal a name of its own and a unit."""
    taken: set[str] = set()
    elements = {c.element for c in states if not c.element.isdigit()} - {""}
    for group, suffix in ((states, "state"), (controls, "command")):
        kinds = {c.kind for c in group}
        plain = {c: "_".join(_words(c, len(kinds) > 1)) for c in group}
        array = {c: re.sub(r"\d+$", "", name) if c.path.endswith("]") else name for c, name in plain.items()}
        for candidate, name in plain.items():  # entries of one array have names of one form
            others = (c for c in group if array[c] == array[candidate] and (candidate.ready or not c.ready))
            alike = [other.topic for other in others]
            name = "_".join([*_apart(candidate.topic, alike), name])
            if name in taken or (suffix == "command" and candidate.element in elements):
                name = f"{name}_{suffix}"
            numbered = (f"{name}_{number}" for number in count(2))
            candidate.name = next(n for n in chain([name], numbered) if n not in taken)
            taken.add(candidate.name)
            candidate.unit = candidate.unit or next((u for pattern, u in _UNITS if pattern.search(candidate.path)), "")


def _words(candidate: Candidate, several_kinds: bool) -> list[str]:
    """Words of a name: those of the path that say something, else the topic's last."""
    if candidate.element and not candidate.element.isdigit():
        words = [re.sub(r"\W+", "_", candidate.element).strip("_") or "entry"]
        return [*words, *words_of(candidate.kind)] if several_kinds else words
    inner = re.sub(rf"^({OF_QUATERNION})\(.*", r"\1", FieldPath(candidate.path).angle)
    inner = re.sub(rf"^({'|'.join(FUNCTIONS)})\(|\)$", "", inner)
    words = [w for w in words_of(inner) if w not in _DULL or of_table(candidate.topic)]
    *folders, last = map(words_of, candidate.topic.strip("/").split("/"))
    of_topic = [*folders[-1], *last] if folders and all(len(w) == 1 for w in last) else last  # /gyro/z
    if all(len(w) == 1 or w.isdigit() for w in words):
        array = candidate.kind if "[" in candidate.path else ""  # of a table, whose topic says nothing more
        words = [*(words_of(array) if of_table(candidate.topic) else of_topic), *words]
    elif of_topic[-len(words) :] == words:  # /exhaust_temperature temperature
        words = of_topic
    return words or ["signal"]


def _apart(topic: str, alike: Sequence[str]) -> list[str]:
    """What tells a topic from others, such as `robot1` of `/robot1/odom` from `/robot2/odom`."""
    each = [other.strip("/").split("/") for other in alike]
    first = next((i for i, of in enumerate(zip_longest(*each)) if len(set(of)) > 1), len(topic))
    return topic.strip("/").lower().split("/")[first : first + 1]


def words_of(text: str) -> list[str]:
    """Words of a name, in small letters: `gnss`, `pos`, `time` of `gnss_posTime`."""
    return [w.lower() for w in _PARTS.findall(text)]


def of_wheel(candidate: Candidate) -> bool:
    """Whether a number is what the encoder of a wheel or a motor counts, by its name."""
    topic = "" if of_table(candidate.topic) else candidate.topic.rpartition("/")[2]
    return _WHEEL.search("_".join(words_of(f"{topic} {FieldPath(candidate.path).angle}"))) is not None


_BITS = [*np.exp2(range(8, 17)).tolist(), 2.0**32]


ATTITUDE = "of an attitude, as the squares of the four add up to 1; its angles are read if x, y, z, w end the names"
"""Why numbers that nothing says the order of are no states: a quaternion turns by products."""


def of_attitude(parts: Sequence[Candidate]) -> bool:
    """Whether numbers are the four of a quaternion."""
    norm = np.sqrt(sum(np.concatenate(c.values) ** 2 for c in parts)) if len(parts) == 4 else np.zeros(1)
    unit = np.abs(norm[np.isfinite(norm)] - 1.0) < 0.02
    return len(unit) > 0 and bool(unit.mean() > 0.9)


def turn_of_count(candidate: Candidate) -> float:
    """After how much the count of a wheel begins anew, by the bits that it fills, if it did; else 0."""
    if not of_wheel(candidate):
        return 0.0
    counts = [v[np.isfinite(v)] for v in candidate.values if np.isfinite(v).sum() > 1]
    for turn in _BITS if counts else ():
        jumps = [np.abs(np.diff(v)) > 0.8 * turn for v in counts]
        if any(map(np.any, jumps)) and max(map(np.ptp, counts)) < turn:
            steps = [np.abs(np.diff(np.unwrap(v, period=turn))) for v in counts]
            # it goes on there as it does between, which a count that is set to 0 does not
            jumped, others = (np.concatenate([s[j == of] for s, j in zip(steps, jumps, strict=True)]) for of in (1, 0))
            return turn if jumped.max() <= 1.5 * others.max(initial=1.0) else 0.0
    return 0.0


def of_compass(candidate: Candidate) -> bool:
    """Whether a number is the direction in which a vehicle is, by its name."""
    return _COMPASS.search(_called(candidate)) is not None


def _called(candidate: Candidate) -> str:
    """The field, or the last word of the topic, where its message holds this number alone."""
    angle = FieldPath(candidate.path).angle
    return candidate.topic.rpartition("/")[2] if angle == "data" else angle


def columns_of(states: Sequence[Candidate], controls: Sequence[Candidate]) -> list[Array]:
    """Of each recording the values (messages of the clock, signals) of states and controls, as old as they may be."""
    clock = clock_of(states)
    oldest = [(c, None) for c in states] + [(c, longest_hold(c.source, clock)[0]) for c in controls]
    return [np.column_stack([held(c, k, clock, age) for c, age in oldest]) for k in range(len(clock.arrival))]


def set_operating_point(states: Sequence[Candidate], controls: Sequence[Candidate]) -> None:
    """Steady states and scales by the rule for `auto`; the range where the magnitude is small compared with it."""
    group = [*states, *controls]
    recordings = [r for r in columns_of(states, controls) if len(r)]
    signals = [Signal(c.name, c.topic, c.path, "auto", "auto") for c in group]
    steady, scale, _ = resolve_auto(signals, recordings)
    pooled = np.concatenate(recordings)
    for j, candidate in enumerate(group):
        finite = pooled[np.isfinite(pooled[:, j]), j]
        span = float(np.ptp(finite)) if len(finite) else 0.0
        candidate.steady = steady[j] if abs(steady[j]) > 1e-3 * span else 0.0
        of_range = scale[j] <= 0.1 * span or of_wheel(candidate)  # a count begins anywhere, and moves by little of it
        candidate.scale = _listed(span if of_range else scale[j])


def set_own_scale(candidate: Candidate) -> None:
    """Median and range, for one in a comment."""
    finite = candidate.finite
    candidate.steady, candidate.scale = float(np.median(finite)), _listed(float(np.ptp(finite)))


def _listed(scale: float) -> float:
    """The nearest scale that a signals file may have; 0 stays."""
    return min(max(scale, 1.0 / LARGEST), LARGEST) if scale else 0.0


def longest_hold(source: Source, clock: Source) -> tuple[float | None, str]:
    """Greatest age of a command that comes at a steady rate and ends, or pauses, before the states do."""
    if source.topic == clock.topic:  # it comes with the states
        return None, ""
    runs = [run[run > 0] for a in source.arrival if len(run := np.diff(a) * 1e-9) and run.any()]
    if not runs:
        return None, ""
    steps = np.concatenate(runs)
    usual = max(float(np.median(run)) for run in runs)  # of the slowest recording
    long = float(np.percentile(steps, 99))
    if long > 4 * usual:
        return None, "comes now and then, and holds until the next one"
    pauses = float(steps.max()) > 10 * usual
    for mine, theirs in zip(source.arrival, clock.arrival, strict=False):
        pauses |= len(mine) > 0 and len(theirs) > 0 and (theirs[-1] - mine[-1]) * 1e-9 > 10 * usual
    if not pauses:
        return None, ""
    limit = max(5 * usual, 2 * long, 1.0 / clock.rate)
    power = 10.0 ** math.floor(math.log10(limit))
    return next(f * power for f in (1, 2, 5, 10) if f * power >= limit), "s; older ones have ended"


def memory_lines(states: Sequence[Candidate], controls: Sequence[Candidate]) -> list[str]:
    """Lines of what narrows the envelope of the proposed states on left-out data, and of how fast wheels turned."""
    group, clock = [*states, *controls], clock_of(states)
    names, n, transients = [c.name for c in group], len(states), []
    for number, z in enumerate(columns_of(states, controls)):
        if len(z) < FEWEST:
            continue
        z = np.column_stack([earlier(column, c.delay) for column, c in zip(z.T, group, strict=True)])
        z = (z - [c.steady for c in group]) / [c.scale or 1.0 for c in group]
        t, _ = clock.instants(clock, number)
        with suppress(TransientError):
            transients.append(Transient(t, z[:, :n], z[:, n:], state_names=names[:n], control_names=names[n:]))
    if not transients:
        return []
    on = endless(states, controls)
    if chosen := tuple(Remembered(c.name, Memory("rate")) for c in on if of_wheel(c)):
        gain = "how fast it turned"
    else:
        chosen, width = choose_memories(transients, "noise")
        gain = f"with it, mean width x {width:.2g} on left-out data"
    lines = ["  # known before the step, so without a row of its own and without a verdict"] if chosen else []
    for one in chosen:
        of = group[names.index(one.of)]
        one = replace(one, memory=Memory("rate")) if of in on else one  # what it was alone says nothing
        memory = one.memory if not of.delay else Memory("lag", of.delay + one.memory.samples)
        steady = of.steady if memory.kind == "lag" else 0.0
        path, unit = memory.of(of.path), memory.unit(of.unit)
        recalled = replace(of, name=one.name, path=path, steady=steady, unit=unit, delay=0)
        lines.append(entry(recalled, comment=gain))
    return lines


_LONGEST_LINE = 1 << 20  # letters
_ADDITIVE = f"# The further term that measured data needs: {CHOICES_TEXT}; compare the widths they give."


_OPEN = TableLayout()
_SCALES = (
    "# steady: median over the longest stretch in which nothing moves; scale: the largest such",
    "# magnitude, or the range where that is small. Both in recorded units.",
)
_SCALES_OF_PLANT = (
    "# Process data: every measurement is judged. fit takes the medians as steady states, where they",
    "# see clearly smaller faults. scale: range, in recorded units.",
)


def signals_file(
    bags: Sequence[Recording], sources: Sequence[Source], states: Sequence[Candidate], controls: Sequence[Candidate],
    doubt: str, memories: Sequence[str] = (), members: Mapping[str, Sequence[Candidate]] = MappingProxyType({}),
    layout: TableLayout = _OPEN, plant: bool = False,
) -> str:  # fmt: skip
    """Write the text of the file."""
    around = endless(states, controls)
    lines = [
        "# Proposed by `uncertain-lti init`; read it, and edit it. From:",
        *_recordings(bags),
        "# States are what the machine remembers from one sample to the next; controls are what is done to it, as",
        "# it is commanded. Then: uncertain-lti fit BAG... --signals THIS_FILE --output machine.model.json",
        "",
        *([] if plant else [_ADDITIVE, f"additive: {'both' if any(map(of_wheel, around)) else 'noise'}", ""]),
        *_sample_times(bags, states, controls),
        *_layout_lines(layout),
        "",
        *(_SCALES_OF_PLANT if plant else _SCALES),
        *([f"# Beware: {doubt}."] if doubt else []),
    ]
    if any(c.ignore for c in [*states, *controls]):
        said = "numbers that stand for no value, as they lie far from all others; they count as missing."
        lines.append(f"# ignore: {said}")
    ready = [c for s in sources for c in s.candidates if c.ready]
    lines += ["states:", *(entry(c, comment=c.why) for c in states), *memories]
    lines += [entry(c, comment=c.reason, out=True) for c in ready if c.ready == "state"]
    lines += _of_controls(controls, [c for c in ready if c.ready == "control"], None if plant else clock_of(states))
    proposed = {*states, *controls, *(c for alike in members.values() for c in alike)}
    if left_out := _left_out(sources, proposed):
        lines += ["", "# Not proposed, and why:", *left_out]
    if members:
        lines = for_members(lines, states[0].element, members)
    elif around:
        lines += ["", "# Nothing depends on how many turns there were, or on where a vehicle is or heads for."]
        lines.append("structure:")
        lines += [f'  - {{state: "*", from: {_quoted(c.name)}, nominal: 0, half_width: 0}}' for c in around]
    return "\n".join(printable(line, _LONGEST_LINE) for line in lines) + "\n"  # names may hold line breaks


def _sample_times(bags: Sequence[Recording], states: Sequence[Candidate], controls: Sequence[Candidate]) -> list[str]:
    topics, clock = {c.topic: c.source for c in [*states, *controls]}, clock_of(states)
    offsets = [source.offset or 0.0 for source in topics.values()]  # log time where there is no stamp
    by_arrival = any(source.halting for source in topics.values()) or max(offsets) - min(offsets) > 1.0
    instants = clock.arrival if by_arrival else [clock.instants(clock, k)[0] for k in range(len(clock.arrival))]
    by_them = replace(clock, arrival=instants)
    period = even_ns(clock.stamp) if by_arrival and clock.stamped and not clock.halting else None
    lines = [
        f"# Its messages define the sample instants: {by_them.rate:.4g} a second.",
        f"clock: {_quoted(clock.topic)}",
    ]
    if by_arrival or clock.offset is None:
        lines += [f"# Beware: {other}." for other in of_another_clock(bags[0], clock.topic)]
    if pause := longest_pause(instants):
        lines += ["", "# They come in bursts, and their samples evenly.", "step: constant", f"max_gap: {pause:g}"]
    elif period:
        lines += [
            "",
            "# They arrive by another clock than that of their stamps, as of a simulation, by which they come",
            "# evenly.",
            f"step: {period * 1e-9:g}",
        ]
    elif unit := coarse_ns(instants):
        lines += ["", f"# Its stamps are rounded to {unit * 1e-9:g} s, and its samples come evenly.", "step: constant"]
    if by_arrival:
        lines += ["", "# Not all header stamps move, are in each recording and of one clock: times of arrival"]
        lines += ["# serve for all.", "topics:", *(f"  {_quoted(t)}: {{time: log}}" for t in topics)]
    return lines


def _layout_lines(layout: TableLayout) -> list[str]:
    if not (table := layout.to_dict()):
        return []
    words = [f"{_quoted(k)}: [{', '.join(map(_quoted, v))}]" for k, v in table.pop("words", {}).items()]
    texts = {key: _number(v, exact=True) if key == "step" else _quoted(v) for key, v in table.items()}
    texts |= {"words": f"{{{', '.join(words)}}}"} if words else {}
    said = ["", "# Columns of the time and of the runs, each value of which is a recording; or the"]
    said.append("# seconds from row to row.")
    said += ["# words: COLUMN_WORD of each but the first is 1 where it stands, else 0."] * bool(words)
    return [*said, "table:", *(f"  {key}: {text}" for key, text in texts.items())]


def _of_controls(controls: Sequence[Candidate], further: Sequence[Candidate], clock: Source | None) -> list[str]:
    if not controls:
        return ["", "# No command can be used. Without controls the envelope must cover what they do.", "controls: []"]
    lines = ["", "controls:"]
    if any(c.source.role == "guess" for c in controls):
        lines.append("  # by correlation alone: nothing is called a command here")
    if any(c.delay for c in controls):
        lines.append("  # delay: number of samples by which the states follow later")
    for candidate in [*controls, *further]:
        limit, why = longest_hold(candidate.source, clock) if clock else (None, candidate.why)
        lines.append(entry(candidate, limit, candidate.reason or why, out=bool(candidate.ready)))
    return lines


def _recordings(bags: Sequence[Recording]) -> list[str]:
    """A line for each recording, or, of many, for the first and the last."""
    names = [bag.path.name for bag in bags]
    if len(set(names)) < len(names):  # files of one name in several folders
        names = [str(bag.path) for bag in bags]
    if len(names) > _LISTED:
        return [f"#   {names[0]} to {names[-1]}: {len(names)}"]
    return [f"#   {name}" for name in names]


_LISTED = 40


def endless(states: Sequence[Candidate], controls: Sequence[Candidate]) -> list[Candidate]:
    """States on which nothing depends, as they go on from turn to turn, or where the next drive goes."""
    holds = any(map(_goes_round, controls))
    steered = holds or any(_COURSE.search(_called(c)) for c in controls)

    def is_free(state: Candidate) -> bool:
        if of_wheel(state):
            return not _is_pulled(state, controls)
        heads = (of_compass(state) and FieldPath(state.path).unwrap) or _is_of_turning(state, states)
        goes_on = heads and not steered and not _is_pulled(state, controls)
        return bool(goes_on or (_goes_round(state) and not (holds and _is_pulled(state, controls))))

    return [c for c in states if is_free(c)]


_PLACE = re.compile(r"(.*\b)(position|translation)\.[xy]")
_TURNS = 1.0
"""rad, by which a body turns at least whose place goes where it heads."""


def _is_of_turning(place: Candidate, states: Sequence[Candidate]) -> bool:
    """Whether it is a coordinate of a vehicle on the map, which another drive may take elsewhere."""
    base = match[1] if (match := _PLACE.fullmatch(place.path)) else None
    yaws = (c for c in states if c.topic == place.topic and c.path == f"unwrap(yaw({base}orientation))")
    return any(np.ptp(c.finite) > _TURNS for c in yaws)


TELLS = 0.02
"""Share of what else is not known of a change that a count, or a heading, tells, from which on it matters."""


def _is_pulled(state: Candidate, controls: Sequence[Candidate]) -> bool:
    """Whether a count changes by what it is, given how fast it changed: that of a pendulum, or of a servo.

    Or a heading by what it is and what is commanded.
    """
    steps = steps_of([state], [state, *controls], [1] + [c.delay for c in controls])
    rate, of = steps.X - steps.U[:, :1], np.hstack([steps.X, steps.U[:, 1:]])
    shown = Steps(rate, of, steps.dX).effects()[1:, 0] > max(SHOWS, TELLS * len(rate))
    return bool(shown[0] and (of_wheel(state) or shown[1:].any()))


def _goes_round(candidate: Candidate) -> bool:
    """Whether an angle went round by half a turn or more, in one recording or in all: each may begin elsewhere."""
    turn = FieldPath(candidate.path).unwrap
    if not turn:
        return False
    around = np.unique(candidate.finite % turn)
    return bool(np.diff(around, append=around[0] + turn).max() <= turn / 2)


def for_members(lines: Sequence[str], one: str, members: Mapping[str, Sequence[Candidate]]) -> list[str]:
    """The lines of one member of many alike as templates for all of them, or, where its place differs, for each."""
    found = []

    def number_in_each(line: str) -> list[Candidate]:
        for k, own in enumerate(members[one]):
            if _in_yaml(own.path) in line and f" {_quoted(own.topic)}," in line:
                return [of[k] for of in members.values()]
        return []

    for line in lines:
        if line.startswith("states:"):
            alike = f"# {len(members)} that are alike: each depends on its own states and controls."
            found += [f"{alike} Shorten the lists to watch fewer.", "structure: own", ""]
        name = re.match(r"  - \{name: ([^,]+),", line)
        if name is None or not (of := number_in_each(line)):
            found.append(line)
            continue
        if not re.search(r'field: "(rate|diff)\(', line):
            line = re.sub(r"steady: [^,}]+, scale: [^,}]+", "steady: auto, scale: auto", line)
        paths = {member: _in_yaml(candidate.path) for member, candidate in zip(members, of, strict=True)}
        mine, rest = paths[one], line[name.end() :]
        place = mine.replace(f"[{one}]", "[{}]")
        if all(path == place.replace("{}", member) for member, path in paths.items()):
            paths = {", ".join(map(_quoted, members)): place}
        for listed, path in paths.items():
            found.append(f"  - {{for: [{listed}], name: {_place(name[1], one)}," + rest.replace(mine, path))
    return found


def _place(name: str, member: str) -> str:
    """Name of a signal with a place for the member."""
    plain = name.strip('"')
    word = re.sub(r"\W+", "_", member).strip("_")
    return '"' + (plain.replace(word, "{}", 1) if word in plain else "{}_" + plain) + '"'


def _quoted(text: str) -> str:
    """As YAML takes it: plain where it may stand so, and is not read as a number or a truth value."""
    special = re.fullmatch(r"(?i)(y|n|yes|no|on|off|true|false|null|nan|\\.inf)", text)
    if re.fullmatch(r"[A-Za-z_/][A-Za-z0-9_./^-]*", text) and not special:
        return text
    return json.dumps(text, ensure_ascii=not text.isprintable())


def entry(candidate: Candidate, max_hold: float | None = None, comment: str = "", out: bool = False) -> str:
    """Line of a signal."""
    parts = [f"name: {_quoted(candidate.name)}", f"topic: {_quoted(candidate.topic)}"]
    parts.append(f'field: "{_in_yaml(candidate.path)}"')
    parts += [f"steady: {_number(candidate.steady)}", f"scale: {_number(candidate.scale)}"]
    parts += [f"unit: {_quoted(candidate.unit)}"] * bool(candidate.unit)
    parts += [] if max_hold is None else [f"max_hold: {_number(max_hold)}"]
    parts += ["judged: true"] * candidate.judged
    parts += [f"delay: {candidate.delay}"] * bool(candidate.delay)
    parts += [f"ignore: [{', '.join(_number(v, exact=True) for v in candidate.ignore)}]"] * bool(candidate.ignore)
    return f"  {'# ' * out}- {{{', '.join(parts)}}}" + (f" # {comment}" if comment else "")


def _in_yaml(path: str) -> str:
    return re.sub(r'(["\\])', r"\\\1", path)


def _number(value: float, exact: bool = False) -> str:
    """Six digits, or every digit, as YAML reads a number (1e-05 would be a text)."""
    text = repr(value) if exact else f"{value:.6g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _left_out(sources: Sequence[Source], chosen: set[Candidate]) -> list[str]:
    lines, parts = [], Counter(source.topic for source in sources)
    for source in sources:
        groups: dict[str, list[str]] = {}
        for candidate in source.candidates:
            if candidate not in chosen and not candidate.ready:
                groups.setdefault(candidate.reason or source.reason, []).append(candidate.path)
        of = {reason: f" {shortlist(paths, 6)}" for reason, paths in groups.items()}
        if source.reason and set(groups) <= {source.reason} and parts[source.topic] == 1:
            of = {source.reason: ""}
        lines += [f"#   {source.topic}{paths}: {' '.join(reason.split())}" for reason, paths in of.items()]
    return lines


def as_unwatched(sources: Sequence[Source]) -> list[str]:
    """What is said of topics of the machine of which no state is, as they are slower or of none of its members."""
    found = []
    for why in dict.fromkeys(s.apart for s in sources if s.apart):
        topics = [s.topic for s in sources if s.apart == why]
        verb, them = ("is", "it") if len(topics) == 1 else ("are", "them")
        remedy = f"for a second model `init` the same recordings with --states {' '.join(topics)}"
        found.append(f"{shortlist(topics, 3)} {verb} {why}, so nothing watches {them}; {remedy}")
    return found
