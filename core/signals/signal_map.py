# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""SignalMap: which topic and field is which state or control."""

from __future__ import annotations

import contextlib
import math
import os
import reprlib
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from uncertain_lti.base.errors import SignalError, refuse_other
from uncertain_lti.base.html_table import html_table, name_with_unit, number_text
from uncertain_lti.base.limits import LARGEST, LONGEST_S
from uncertain_lti.signals.additive import CHOICES, CHOICES_TEXT, Additive
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.field_types import TypeFields
from uncertain_lti.signals.file_values import checked_mapping, checked_number, kind_in_yaml, load_yaml
from uncertain_lti.signals.horizon_rule import HorizonRule
from uncertain_lti.signals.memory import LONGEST_DELAY, Memory, parse_memory
from uncertain_lti.signals.table_layout import TableLayout
from uncertain_lti.signals.templates import expand

Number = float | Literal["auto"]


TimeSource = Literal["header", "log"]


STEP_CHOICES = "recorded, constant, or the period in seconds"
"""What `step` may be."""


@dataclass(frozen=True, slots=True)
class Signal:
    """One state or control: where it is read, and the operating point it is measured from.

    `name`: name of the signal; each in a map has its own; `topic`: topic that carries it; `field`: path of the number
    in the message, as `FieldPath` reads it; `steady`: steady state in recorded units; `auto` asks for the rule in
    `operating_point`; `scale`: positive scale in recorded units; `auto` likewise; `unit`: unit as it is shown; `type`:
    message type of the topic; empty while it is unknown; `max_hold`: greatest age, s, at which a held control still
    counts; None for no limit. For controls only; `delay`: samples by which a control is shifted: sample k takes u(t_{k
    - delay}). For controls only; `valid`: least and greatest value of the field; beyond them it counts as missing. None
    for no limit; `ignore`: values of the field that stand for none; each also as single precision rounds it.
    """

    name: str
    topic: str
    field: str
    steady: Number = 0.0
    scale: Number = 1.0
    unit: str = ""
    type: str = ""
    max_hold: float | None = None
    delay: int = 0
    valid: tuple[float, float] | None = None
    ignore: tuple[float, ...] = ()

    @property
    def memory(self) -> Memory | None:
        """What it takes from earlier samples of its field; None for the present value."""
        return parse_memory(self.field)[0]

    @property
    def inner(self) -> str:
        """Path of the field itself, without the memory."""
        return parse_memory(self.field)[1]

    def admits(self, value: float) -> bool:
        """Whether a value of the field counts."""
        low, high = self.valid or (-math.inf, math.inf)
        return not (value < low or value > high or value in self.ignored)

    @property
    def ignored(self) -> frozenset[float]:
        """`ignore`, and its values as single precision rounds them."""
        return frozenset(v for code in self.ignore for v in (code, _single(code)))


def _single(value: float) -> float:
    """The nearest number of single precision; the value itself beyond its range."""
    try:
        rounded: float = struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return value
    return rounded


@dataclass(frozen=True)
class Recalled:
    """A signal that follows from another one's samples.

    `position`: of the signal in [x; u; s]; `of`: of the state or control whose samples they are; `memory`: how it
    follows.
    """

    position: int
    of: int
    memory: Memory


@dataclass(frozen=True)
class ScheduleRule:
    """What a signals file says of one scheduling signal.

    `signal`: A state, a control or a further scheduling signal; `knots`: chosen by what is left out, a number of knots,
    or knots in recorded units; None for modes; `modes`: values of a discrete signal, in recorded units.
    """

    signal: str
    knots: Literal["auto"] | int | tuple[float, ...] | None = None
    modes: tuple[float, ...] = ()


class UncarriedTopicError(SignalError):
    """A signals file names a topic that carries no signal.

    `text`: the sentence for a person; `topics`: the topics that do carry a signal, any of which may be misspelt.
    """

    def __init__(self, text: str, topics: tuple[str, ...]) -> None:
        super().__init__(text)
        self.topics = topics


@dataclass(frozen=True)
class SignalMap:
    """Which topic and field is which state or control, and how samples are cut from the messages.

    Parameters
    ----------
    states : tuple of Signal
        States, in the order of x; at least one. One whose field is a memory (lag, diff or rate) is known before the
        step and so has no row: it becomes the last of the controls.
    controls : tuple of Signal, optional
        Controls, in the order of u.
    scheduling : tuple of Signal, optional
        Further signals that are neither state nor control, and schedule the model.
    clock : str or None, optional
        Topic whose messages define the sample instants; None for the slowest state topic.
    max_gap : float or None, optional
        Longest step that is still a transition, s; None for 2.5 x the median step.
    min_step : float, default 0.0
        Shortest step, s; a message sooner than that is dropped.
    max_skew : float or None, optional
        Greatest age of a state from another topic than the clock, s; None for `max_gap`.
    step : "recorded", "constant" or float, default "recorded"
        Δt: between stamps; or one period for every step that is no gap, estimated or given, s.
    time : mapping of str to {"header", "log"}, optional
        Per topic whether its instant is the header stamp or the log time; for a topic that is left out, header where
        most of its messages carry a stamp.
    additive : {"none", "disturbance", "noise", "both"} or None, optional
        The additive term of a fit that is given none.
    schedule : tuple of ScheduleRule, optional
        How a fit that is given no schedule is scheduled; empty for one block.
    horizons : HorizonRule or None, optional
        Over which horizons a fit that is given none has envelopes; None for one step.
    structure : object, optional
        The rules on single elements that a fit keeps (`identification.structure`); None for no rule.
    table : TableLayout or None, optional
        Which columns of tables are time and run; None to look for them.
    source : str, default "signals"
        What errors call the map: the path of its file.

    Raises
    ------
    SignalError
        A name is used twice, a number is out of range, a field is not a field path, or nothing is a state.
    """

    states: tuple[Signal, ...]
    controls: tuple[Signal, ...] = ()
    scheduling: tuple[Signal, ...] = ()
    clock: str | None = None
    max_gap: float | None = None
    min_step: float = 0.0
    max_skew: float | None = None
    step: Literal["recorded", "constant"] | float = "recorded"
    time: Mapping[str, TimeSource] = field(default_factory=dict)
    additive: Additive | None = None
    schedule: tuple[ScheduleRule, ...] = ()
    horizons: HorizonRule | None = None
    structure: Any = None
    table: TableLayout | None = None
    source: str = "signals"

    def __post_init__(self) -> None:
        for kind in ("states", "controls", "scheduling"):
            signals = getattr(self, kind)
            refuse_other(signals, (tuple, list), f"{self.source}: {kind}", "give a list of signals", SignalError)
            for signal in signals:
                refuse_other(signal, Signal, f"{self.source}: one of {kind}", "give a Signal", SignalError)
            object.__setattr__(self, kind, tuple(signals))
        self._place_memories()
        if not self.states:
            raise SignalError(f"{self.source}: 'states' is empty; list at least one state")
        seen: set[str] = set()
        for signal in self.signals:
            where = f"{self.source}: signal '{signal.name}'"
            if signal.name in seen:
                raise SignalError(f"{where} is listed twice; give each signal its own name")
            seen.add(signal.name)
            try:
                FieldPath(signal.field)
            except SignalError as error:
                raise SignalError(f"{where}: {error}") from None
            if signal.scale != "auto" and not 1 / LARGEST <= signal.scale <= LARGEST:
                raise SignalError(
                    f"{where}: scale is {signal.scale}; it must be a positive number or auto, {1 / LARGEST:g} to "
                    f"{LARGEST:g}"
                )
            if signal.steady != "auto" and not -LARGEST <= signal.steady <= LARGEST:
                raise SignalError(
                    f"{where}: steady is {signal.steady}; it must be a finite number or auto, up to {LARGEST:g}"
                )
            if signal.max_hold is not None and not 0 <= signal.max_hold <= LONGEST_S:
                raise SignalError(
                    f"{where}: max_hold is {signal.max_hold}; it must be 0 s or more, up to {LONGEST_S:g}, or left out "
                    f"for no limit"
                )
            if not 0 <= signal.delay <= LONGEST_DELAY:
                raise SignalError(
                    f"{where}: delay is {reprlib.repr(signal.delay)}; it must be 0 to {LONGEST_DELAY} samples"
                )
            if signal.delay and signal.memory:
                raise SignalError(f"{where}: {signal.field} has a delay, too; leave it out, or write lag(field, k)")
            if signal.valid is not None and not signal.valid[0] < signal.valid[1]:
                raise SignalError(f"{where}: valid is {list(signal.valid)}; write [least, greatest]")
            if any(math.isnan(code) for code in signal.ignore):
                raise SignalError(f"{where}: ignore lists NaN, which never counts; leave it out")
        for signal in self.states:
            if signal.max_hold is not None or signal.delay:
                raise SignalError(
                    f"{self.source}: state '{signal.name}' has max_hold or delay; both are for controls "
                    f"(the age of a state is limited by max_skew)"
                )
        for signal in self.scheduling:
            if signal.delay:
                raise SignalError(f"{self.source}: scheduling signal '{signal.name}' has a delay; that is for controls")
        for rule in self.schedule:
            if rule.signal not in seen:
                raise SignalError(
                    f"{self.source}: schedule: '{rule.signal}' is no state, control or scheduling signal; there are "
                    f"{', '.join(s.name for s in self.signals)}"
                )
        if self.clock is not None and self.clock not in {s.topic for s in self.states}:
            raise UncarriedTopicError(
                f"{self.source}: clock is {self.clock}, which carries no state; choose one of "
                f"{', '.join(dict.fromkeys(s.topic for s in self.states))}",
                self.topics,
            )
        for topic in self.time:
            if topic not in self.topics:
                raise UncarriedTopicError(
                    f"{self.source}: 'topics' names {topic}, which carries no signal; "
                    f"signals come from {', '.join(self.topics)}",
                    self.topics,
                )
        if isinstance(self.step, str):
            if self.step not in ("recorded", "constant"):
                raise SignalError(f"{self.source}: step is {reprlib.repr(self.step)}; write {STEP_CHOICES}")
        elif not 1e-9 <= self.step <= LONGEST_S:
            raise SignalError(f"{self.source}: step is {self.step}; it must be 1e-9 to {LONGEST_S:g} s")
        for name in ("max_gap", "max_skew"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= LONGEST_S:
                raise SignalError(
                    f"{self.source}: {name} is {value}; it must be a positive number of seconds, at most {LONGEST_S:g}"
                )
        if not 0 <= self.min_step <= LONGEST_S:
            raise SignalError(
                f"{self.source}: min_step is {self.min_step}; it must be 0 s or more, up to {LONGEST_S:g}"
            )

    def _place_memories(self) -> None:
        """Put memories among the states after the controls; what is valid of a listed field is so of its memories."""
        memories = tuple(s for s in self.states if _recalls(s))
        if memories:
            object.__setattr__(self, "states", tuple(s for s in self.states if not _recalls(s)))
            object.__setattr__(self, "controls", (*self.controls, *memories))
            if not self.states:
                raise SignalError(
                    f"{self.source}: every state is a lag, diff or rate, which has no row of its own; list the field "
                    f"itself as a state, too"
                )
        known = {(s.topic, s.field): s for s in reversed(self.signals)}
        for group in ("controls", "scheduling"):
            signals = list(getattr(self, group))
            for i, signal in enumerate(signals):
                listed = known.get((signal.topic, signal.inner)) if _recalls(signal) else None
                if listed is not None and signal.valid is None and not signal.ignore:
                    signals[i] = replace(signal, valid=listed.valid, ignore=listed.ignore)
            object.__setattr__(self, group, tuple(signals))

    def __len__(self) -> int:
        return len(self.signals)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self.signals)

    def __getitem__(self, position: int) -> Signal:
        """Signal at a position of [x; u; s]."""
        return self.signals[position]

    @property
    def signals(self) -> tuple[Signal, ...]:
        """States, controls, then further scheduling signals: the order of z = [x; u; s]."""
        return self.states + self.controls + self.scheduling

    @property
    def held(self) -> tuple[Signal, ...]:
        """Signals whose last value holds until the next: controls, then further scheduling signals."""
        return self.controls + self.scheduling

    @property
    def recalled(self) -> tuple[Recalled, ...]:
        """Signals that follow from the samples of a state or control that is listed, too; a delayed one is a lag."""
        plain = [(i, s) for i, s in enumerate(self.signals) if not s.delay and s.memory is None]
        at = {(s.topic, s.inner): i for i, s in reversed(plain)}
        found = []
        for position, signal in enumerate(self.signals):
            memory = Memory("lag", signal.delay) if signal.delay else signal.memory
            of = at.get((signal.topic, signal.inner))
            if memory is not None and of is not None and of != position:
                found.append(Recalled(position, of, memory))
        return tuple(found)

    def branch(self, position: int) -> float:
        """Value nearest to which an angle starts when it is unwrapped.

        Parameters
        ----------
        position : int
            Of the signal in [x; u; s].

        Returns
        -------
        float
            Its steady state, of a memory that of the signal that it recalls; 0 for one that is still open.
        """
        of = next((r.of for r in self.recalled if r.position == position), position)
        steady = self.signals[of].steady
        return 0.0 if steady == "auto" else steady

    def longest_age(self, position: int) -> float:
        """Age at which the value of another topic than the clock still counts.

        Parameters
        ----------
        position : int
            Of the signal in [x; u; s].

        Returns
        -------
        float
            s: of a state, and of the memory of a topic of states, max_skew or else max_gap; of the others max_hold.
        """
        signal = self.signals[position]
        if signal.max_hold is not None:
            return signal.max_hold
        of_state = signal.topic in {s.topic for s in self.states}
        if position < len(self.states) or (of_state and signal.memory is not None):
            age = self.max_gap if self.max_skew is None else self.max_skew
            return math.inf if age is None else age
        return math.inf

    def replace_signals(self, signals: Sequence[Signal]) -> SignalMap:
        """The same map with other signals in the place of these.

        Parameters
        ----------
        signals : sequence of Signal
            As many as `signals`, in that order.

        Returns
        -------
        SignalMap
            A new map.
        """
        n, m = len(self.states), len(self.controls)
        return replace(
            self,
            states=tuple(signals[:n]),
            controls=tuple(signals[n : n + m]),
            scheduling=tuple(signals[n + m :]),
        )

    def scheduled_on(self, names: Collection[str]) -> SignalMap:
        """Leave out the further scheduling signals that are not named, and what is said of them.

        Parameters
        ----------
        names : collection of str
            Scheduling signals that stay.

        Returns
        -------
        SignalMap
            With the same states and controls.
        """
        gone = {s.name for s in self.scheduling if s.name not in names}
        if not gone:
            return self
        left = replace(
            self,
            scheduling=tuple(s for s in self.scheduling if s.name not in gone),
            schedule=tuple(rule for rule in self.schedule if rule.signal not in gone),
            time={},
        )
        return replace(left, time={topic: kind for topic, kind in self.time.items() if topic in left.topics})

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that carry a signal, states first, each once."""
        return tuple(dict.fromkeys(s.topic for s in self.signals))

    def on(self, topic: str) -> list[int]:
        """Positions in `signals` of what this topic carries.

        Parameters
        ----------
        topic : str
            Name of a topic.

        Returns
        -------
        list of int
            Positions, increasing; empty for a topic that carries no signal.
        """
        return [i for i, s in enumerate(self.signals) if s.topic == topic]

    def check(self, topic: str, type_name: str, type_fields: TypeFields) -> None:
        """Check every field path of one topic against its message type.

        Parameters
        ----------
        topic : str
            Name of the topic.
        type_name : str
            Type of its messages, as package/msg/Name.
        type_fields : callable
            Type name -> {field name: FieldType}.

        Raises
        ------
        SignalError
            A path is not in the type, or is not one number.
        """
        for i in self.on(topic):
            FieldPath(self.signals[i].field).check(topic, type_name, type_fields)

    def with_types(self, types: Mapping[str, str]) -> SignalMap:
        """The same map with the message type of each topic filled in.

        Parameters
        ----------
        types : mapping of str to str
            Topic -> message type; a topic that is left out keeps the type it has.

        Returns
        -------
        SignalMap
            A new map.
        """
        return self.replace_signals([replace(s, type=types.get(s.topic, s.type)) for s in self.signals])

    def _repr_html_(self) -> str:
        """Where each signal is read, and its operating point; below, how samples are cut."""
        groups = (("state", self.states), ("control", self.controls), ("scheduling", self.scheduling))
        rows = [
            [
                name_with_unit(signal.name, signal.unit),
                kind,
                signal.topic,
                signal.field,
                signal.steady if signal.steady == "auto" else number_text(signal.steady),
                signal.scale if signal.scale == "auto" else number_text(signal.scale),
                "" if signal.max_hold is None else f"{number_text(signal.max_hold)} s",
                str(signal.delay or ""),
            ]
            for kind, group in groups
            for signal in group
        ]
        header = ("signal", "", "topic", "field", "steady", "scale", "max_hold", "delay")
        below = [
            f"{name}: {value}"
            for name in ("clock", "max_gap", "min_step", "max_skew", "step", "additive")
            if (value := getattr(self, name)) not in (None, 0.0, "recorded")
        ]
        return html_table(f"signals ({self.source})", header, rows, below)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SignalMap:
        """Read a signals file (YAML).

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        SignalMap
            The map as the file says it; `auto`, clock and max_gap are still open.

        Raises
        ------
        SignalError
            The file is missing, is not YAML, or a key or value in it is wrong; the sentence names it.
        """
        return cls.from_dict(load_yaml(path), source=os.fspath(path))

    @classmethod
    def from_dict(cls, data: Any, source: str = "signals", need_topics: bool = True) -> SignalMap:
        """Build from the structure of a signals file (see `load`).

        Parameters
        ----------
        data : object
            Mappings, lists, numbers and text, as YAML or JSON gives them.
        source : str, default "signals"
            What errors call it.
        need_topics : bool, default True
            Whether every signal must name its topic; a model fitted to arrays has none.

        Returns
        -------
        SignalMap
            The map.

        Raises
        ------
        SignalError
            A key is unknown or missing, or a value is wrong; the sentence names it.
        """
        top = checked_mapping(
            data,
            source,
            {
                "clock",
                "max_gap",
                "min_step",
                "max_skew",
                "step",
                "additive",
                "schedule",
                "horizons",
                "structure",
                "table",
                "topics",
                "states",
                "controls",
                "scheduling",
            },
        )
        time: dict[str, TimeSource] = {}
        for topic, options in checked_mapping(top.get("topics") or {}, f"{source}: topics", None).items():
            source_of_time = checked_mapping(options, f"{source}: topics: {topic}", {"time"}).get("time")
            if source_of_time not in ("header", "log"):
                raise SignalError(
                    f"{source}: topics: {topic}: time is {reprlib.repr(source_of_time)}; write header or log"
                )
            time[topic] = source_of_time
        top = expand(top, source)
        top = top | _with_memories(top)
        additive = top.get("additive")
        if additive not in (None, *CHOICES):
            raise SignalError(f"{source}: additive is {reprlib.repr(additive)}; write {CHOICES_TEXT}")
        clock = top.get("clock")
        if clock is not None and not isinstance(clock, str):
            raise SignalError(f"{source}: clock is {reprlib.repr(clock)}; write the name of a state topic")
        return cls(
            states=_signals(top.get("states"), f"{source}: states", need_topics),
            controls=_signals(top.get("controls"), f"{source}: controls", need_topics),
            scheduling=_signals(top.get("scheduling"), f"{source}: scheduling", need_topics),
            clock=clock,
            max_gap=checked_number(top.get("max_gap"), f"{source}: max_gap"),
            min_step=checked_number(top.get("min_step"), f"{source}: min_step") or 0.0,
            max_skew=checked_number(top.get("max_skew"), f"{source}: max_skew"),
            step=_step(top.get("step"), f"{source}: step"),
            time=time,
            additive=additive,
            schedule=_schedule(top.get("schedule"), f"{source}: schedule"),
            horizons=HorizonRule.of(top["horizons"], f"{source}: horizons")
            if top.get("horizons") is not None
            else None,
            structure=top.get("structure"),
            table=TableLayout.from_dict(top["table"], f"{source}: table") if top.get("table") is not None else None,
            source=source,
        )


def _recalls(signal: Signal) -> bool:
    """Whether the field is a memory; one that is no field path is refused later, by name."""
    try:
        return signal.memory is not None
    except SignalError:
        return False


def _with_memories(top: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Lists of signals in which a memory has the scale, unit and, of a lag, steady state of the listed field."""
    lists = {key: top[key] for key in ("states", "controls", "scheduling") if isinstance(top.get(key), list)}
    entries = [
        e for entries in lists.values() for e in entries if isinstance(e, dict) and isinstance(e.get("field"), str)
    ]
    listed = {(str(e.get("topic")), e["field"].strip()): e for e in reversed(entries)}
    found: dict[str, list[Any]] = {}
    for key, of_list in lists.items():
        found[key] = []
        for entry in of_list:
            memory = of = None
            if any(entry is e for e in entries):
                with contextlib.suppress(SignalError):  # refused later, by the name of the signal
                    memory, inner = parse_memory(entry["field"])
                    of = listed.get((str(entry.get("topic")), inner))
            if memory is not None and of is not None:
                unit = str(of.get("unit") or "")
                own = {"scale": of.get("scale", 1.0), "unit": f"{unit}/s" if unit and memory.kind == "rate" else unit}
                own |= {"steady": of["steady"]} if memory.kind == "lag" and "steady" in of else {}
                entry = own | entry
            found[key].append(entry)
    return found


def _step(value: Any, where: str) -> Literal["recorded", "constant"] | float:
    if value is None or value == "recorded":
        return "recorded"
    if value == "constant":
        return "constant"
    try:
        number = checked_number(value, where)
    except SignalError:
        raise SignalError(f"{where} is {reprlib.repr(value)}; write {STEP_CHOICES}") from None
    assert number is not None
    return number


def _limits(entry: dict[str, Any], where: str) -> None:
    """Numbers of `valid` and `ignore` in the place of what the file has; null is no limit."""
    for key in ("valid", "ignore"):
        if entry.get(key) is None:
            entry.pop(key, None)
            continue
        value = entry[key]
        if key == "ignore" and not isinstance(value, (list, dict)):
            value = [value]
        if not isinstance(value, list) or (key == "valid" and len(value) != 2):
            wanted = "[least, greatest]" if key == "valid" else "a list of numbers"
            raise SignalError(f"{where}: {key} is {reprlib.repr(value)}; write {wanted}")
        numbers = [checked_number(v, f"{where}: {key}[{i}]") for i, v in enumerate(value)]
        if key == "valid":
            low, high = numbers
            entry[key] = (-math.inf if low is None else low, math.inf if high is None else high)
        elif None in numbers:
            raise SignalError(f"{where}: ignore has an empty entry; write a number")
        else:
            entry[key] = tuple(numbers)


def _schedule(data: Any, where: str) -> tuple[ScheduleRule, ...]:
    if data is None:
        return ()
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    rules = []
    for position, entry in enumerate(data):
        here = f"{where}[{position}]"
        entry = checked_mapping(entry, here, {"signal", "knots", "modes"})
        if not isinstance(entry.get("signal"), str):
            raise SignalError(f"{here}: 'signal' is {reprlib.repr(entry.get('signal'))}; write the name of a signal")
        knots, modes = entry.get("knots"), entry.get("modes")
        if (knots is None) == (modes is None):
            raise SignalError(f"{here}: write knots (auto, a number, or a list) or modes (a list), one of the two")
        if knots is not None and knots != "auto" and not isinstance(knots, list):
            if isinstance(knots, bool) or not isinstance(knots, int) or knots < 1:
                raise SignalError(f"{here}: knots is {reprlib.repr(knots)}; write auto, a number, or a list of knots")
            rules.append(ScheduleRule(entry["signal"], knots))
        elif knots == "auto":
            rules.append(ScheduleRule(entry["signal"], "auto"))
        else:
            which, values = ("knots", knots) if modes is None else ("modes", modes)
            if not isinstance(values, list) or not values:
                raise SignalError(f"{here}: {which} is {reprlib.repr(values)}; write a list of numbers")
            if modes is not None:  # those of a flag, as its field is read
                values = [int(v) if isinstance(v, bool) else v for v in values]
            numbers = [checked_number(v, f"{here}: {which}[{i}]") for i, v in enumerate(values)]
            if None in numbers:
                raise SignalError(f"{here}: {which} has an empty entry; write a number")
            listed = tuple(v for v in numbers if v is not None)
            rules.append(ScheduleRule(entry["signal"], *((listed,) if modes is None else (None, listed))))
    return tuple(rules)


def _signals(data: Any, where: str, need_topics: bool) -> tuple[Signal, ...]:
    if data is None:
        return ()
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    known = {f.name for f in fields(Signal)}
    signals = []
    for position, entry in enumerate(data):
        here = f"{where}[{position}]"
        entry = dict(checked_mapping(entry, here, known))
        for key in ("name", "topic", "field"):
            if not isinstance(entry.get(key), str) or not (entry[key] or (key == "topic" and not need_topics)):
                if entry.get(key) is None:
                    raise SignalError(f"{here}: '{key}' is missing; every signal has a name, a topic and a field")
                raise SignalError(f"{here}: '{key}' is {reprlib.repr(entry.get(key))}; write a text, in quotes")
        for key in ("steady", "scale"):
            if key in entry and entry[key] != "auto":
                number = checked_number(entry[key], f"{here}: {key}")
                entry[key] = number if number is not None else {"steady": 0.0, "scale": 1.0}[key]
        _limits(entry, here)
        if "max_hold" in entry:
            entry["max_hold"] = checked_number(entry["max_hold"], f"{here}: max_hold")
        delay = entry.get("delay", 0)
        if isinstance(delay, bool) or not isinstance(delay, int):
            raise SignalError(f"{here}: delay is {reprlib.repr(delay)}; write a whole number of samples")
        for key in ("unit", "type"):
            text = entry.get(key)
            if isinstance(text, bool) or not isinstance(text, (str, int, float, type(None))):
                raise SignalError(f"{here}: {key} is {reprlib.repr(text)}; write a text, in quotes")
            entry[key] = "" if text is None else str(text)  # a unit of 1 is read as a number
        signals.append(Signal(**entry))
    return tuple(signals)
