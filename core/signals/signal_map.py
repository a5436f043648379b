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

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn

from uncertain_lti.base.arrays import LONGEST_S
from uncertain_lti.base.errors import SignalError, refuse_other
from uncertain_lti.base.text import html_table, named, number
from uncertain_lti.signals.field_path import FieldPath, Memory, TypeFields
from uncertain_lti.signals.signal import LISTS, STEP_CHOICES, map_arguments
from uncertain_lti.signals.signal import Recalled as Recalled
from uncertain_lti.signals.signal import ScheduleRule as ScheduleRule
from uncertain_lti.signals.signal import Signal as Signal
from uncertain_lti.signals.values import Additive, HorizonRule, TableLayout, load_yaml, wrong

TimeSource = Literal["header", "log"]

ARRIVAL = " at arrival"
"""Behind the name of a control: the control that is its value at the end of the step."""


def with_rules(structure: Any, of: Mapping[str, str]) -> Any:
    """Rules of a signals file, with those that a signal has no effect said of signals made of it, too.

    `of`: new name to that of the signal.
    """
    if not isinstance(structure, list):
        return structure
    nothing = [r for r in structure if isinstance(r, dict) and (r.get("nominal"), r.get("half_width")) == (0, 0)]
    more = [{**r, "from": name} for name, signal in of.items() for r in nothing if r.get("from") == signal]
    return [*structure, *more] if more else structure


class UncarriedTopicError(SignalError):
    """A signals file names a topic that carries no signal.

    `text`: the sentence for a person; `topics`: the topics that do carry a signal, any of which may be misspelt.
    """

    def __init__(self, text: str, topics: tuple[str, ...]) -> None:
        super().__init__(text)
        self.topics = topics


def below(prefix: str, topic: str) -> str:
    """A topic below a prefix such as `/robot1`; an empty prefix changes nothing."""
    return f"{prefix.rstrip('/')}/{topic.removeprefix('/')}" if prefix else topic


@dataclass(frozen=True)
class SignalMap:
    """Which topic and field is which state or control, and how samples are cut from the messages.

    Parameters
    ----------
    states : tuple of Signal
        States, in the order of x; at least one. One whose field is a memory (lag, diff or rate) is known before the
        step and so has no row: it becomes the last of the controls.
    controls : tuple of Signal, optional
        Controls, in the order of u. One that is judged has a row, too, and becomes the last of the states.
    scheduling : tuple of Signal, optional
        Further signals that are neither state nor control, and schedule the model.
    clock : str or None, optional
        Topic whose messages define the sample instants; None for the slowest state topic.
    max_gap : float or None, optional
        Longest step that is still a transition, s; None for 2.5 x the median step; 1.5 x with memories of even samples.
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
    ends_given : bool, default False
        A person has said of some control at which end of a step it is taken, so `fit` leaves all of them there.

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
    ends_given: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        for kind in LISTS:
            signals = getattr(self, kind)
            refuse_other(signals, (tuple, list), f"{self.source}: {kind}", "give a list of signals", SignalError)
            for signal in signals:
                refuse_other(signal, Signal, f"{self.source}: one of {kind}", "give a Signal", SignalError)
            object.__setattr__(self, kind, tuple(signals))
        self._place()
        if not self.states:
            self._refuse("'states' is empty; list at least one state")
        seen: set[str] = set()
        for signal in self.signals:
            if signal.name in seen:
                self._refuse(f"signal '{signal.name}' is listed twice; give each signal its own name")
            seen.add(signal.name)
            signal.check(f"{self.source}: signal '{signal.name}'")
        self._check_kinds()
        self._check_topics()
        self._check_numbers()

    def _refuse(self, text: str) -> NoReturn:
        raise SignalError(f"{self.source}: {text}")

    def _check_kinds(self) -> None:
        """Refuse what is for controls, said of another signal, and a schedule on no signal."""
        of_states = {(s.topic, s.field) for s in self.states}
        for s in self.states:
            if (s.max_hold is not None and not s.judged) or s.delay:
                both = "both are for controls (the age of a state is limited by max_skew)"
                self._refuse(f"state '{s.name}' has max_hold or delay; {both}")
        for s in self.scheduling:
            if s.delay:
                self._refuse(f"scheduling signal '{s.name}' has a delay; that is for controls")
        for s in self.states + self.scheduling:
            if s.at != "departure":
                self._refuse(f"'{s.name}' is at {s.at}; that is for controls")
        for s in self.controls:
            if s.at == "arrival" and (s.topic, s.field) in of_states:
                self._refuse(f"control '{s.name}' is a state, which is judged at the arrival; leave `at` out")
        names = [s.name for s in self.signals]
        for rule in self.schedule:
            if rule.signal not in names:
                there = ", ".join(names)
                self._refuse(f"schedule: '{rule.signal}' is no state, control or scheduling signal; there are {there}")

    def _check_topics(self) -> None:
        """Refuse a clock that carries no state, and a time of a topic that carries no signal."""
        of_states = dict.fromkeys(s.topic for s in self.states)
        text = ""
        if self.clock is not None and self.clock not in of_states:
            text = f"clock is {self.clock}, which carries no state; choose one of {', '.join(of_states)}"
        elif topic := next((topic for topic in self.time if topic not in self.topics), ""):
            text = f"'topics' names {topic}, which carries no signal; signals come from {', '.join(self.topics)}"
        if text:
            raise UncarriedTopicError(f"{self.source}: {text}", self.topics)

    def _check_numbers(self) -> None:
        """Refuse steps and ages out of range."""
        if isinstance(self.step, str):
            if self.step not in ("recorded", "constant"):
                raise wrong(f"{self.source}: step", self.step, STEP_CHOICES)
        elif not 1e-9 <= self.step <= LONGEST_S:
            self._refuse(f"step is {self.step}; it must be 1e-9 to {LONGEST_S:g} s")
        for name in ("max_gap", "max_skew"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= LONGEST_S:
                self._refuse(f"{name} is {value}; it must be a positive number of seconds, at most {LONGEST_S:g}")
        if not 0 <= self.min_step <= LONGEST_S:
            self._refuse(f"min_step is {self.min_step}; it must be 0 s or more, up to {LONGEST_S:g}")

    def _place(self) -> None:
        """Put memories among the states behind the controls, both ends of a control, and judged controls to the states.

        What is valid of a listed field is so of its memories.
        """
        states = [s for s in self.states if not s.recalls]
        controls = [*self.controls, *(s for s in self.states if s.recalls)]
        if self.states and not states:
            remedy = "list the field itself as a state, too"
            self._refuse(f"every state is a lag, diff or rate, which has no row of its own; {remedy}")
        known = {(s.topic, s.field): s for s in reversed((*states, *controls, *self.scheduling))}

        def as_listed(signal: Signal) -> Signal:
            listed = known.get((signal.topic, signal.inner)) if signal.recalls else None
            if listed is None or signal.valid is not None or signal.ignore:
                return signal
            return replace(signal, valid=listed.valid, ignore=listed.ignore)

        ends: list[Signal] = []
        arrivals: dict[str, str] = {}
        for signal in map(as_listed, controls):
            if signal.at == "both":
                ends.append(replace(signal, at="departure"))
                arrivals[signal.name + ARRIVAL] = signal.name
                signal = replace(signal, name=signal.name + ARRIVAL, at="arrival")
            ends.append(signal)
        judged = [s for s in ends if s.judged and not (s.delay or s.recalls or s.at != "departure")]
        object.__setattr__(self, "states", (*states, *judged))
        object.__setattr__(self, "controls", tuple(s for s in ends if s not in judged))
        object.__setattr__(self, "scheduling", tuple(map(as_listed, self.scheduling)))
        object.__setattr__(self, "structure", with_rules(self.structure, arrivals))

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
    def arrivals(self) -> tuple[int, ...]:
        """Positions in [x; u; s] of the controls whose value at the end of a step acts during it."""
        return tuple(i for i, s in enumerate(self.signals) if s.at == "arrival")

    @property
    def decided_at_once(self) -> bool:
        """Whether the clock message that opens a sample decides the step to it: it carries all that the step needs.

        Otherwise the step waits for what is to come from other topics, until the next sample opens.
        """
        needed = (*self.states, *(self.signals[i] for i in self.arrivals))
        return all(s.topic == self.clock for s in needed)

    @property
    def recalled(self) -> tuple[Recalled, ...]:
        """Signals that follow from the samples of a state or control that is listed, too; a delayed one is a lag."""
        at_departure = [(i, s) for i, s in enumerate(self.signals) if s.at == "departure"]
        at = {(s.topic, s.inner): i for i, s in reversed(at_departure) if not s.delay and s.memory is None}
        found = []
        for position, signal in at_departure:
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
        age = signal.max_hold
        of_state = signal.topic in {s.topic for s in self.states}
        if age is None and (position < len(self.states) or (of_state and signal.memory is not None)):
            age = self.max_gap if self.max_skew is None else self.max_skew
        return math.inf if age is None else age

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
        n, m = len(self.states), len(self.states + self.controls)
        states, controls, scheduling = tuple(signals[:n]), tuple(signals[n:m]), tuple(signals[m:])
        return replace(self, states=states, controls=controls, scheduling=scheduling)

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
        scheduling = tuple(s for s in self.scheduling if s.name not in gone)
        schedule = tuple(rule for rule in self.schedule if rule.signal not in gone)
        left = replace(self, scheduling=scheduling, schedule=schedule, time={})
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

    def moved(self, there: Callable[[str], str]) -> SignalMap:
        """The same signals on other topics.

        Parameters
        ----------
        there : callable
            Gives the topic in place of each.

        Returns
        -------
        SignalMap
            A new map.
        """
        lists: dict[str, Any] = {
            kind: tuple(replace(s, topic=there(s.topic)) for s in getattr(self, kind)) for kind in LISTS
        }
        time = {there(topic): source for topic, source in self.time.items()}
        return replace(self, **lists, clock=self.clock and there(self.clock), time=time)

    def _repr_html_(self) -> str:
        """Where each signal is read, and its operating point; below, how samples are cut."""
        rows = []
        for kind, group in (("state", self.states), ("control", self.controls), ("scheduling", self.scheduling)):
            for s in group:
                point = [value if isinstance(value, str) else number(value) for value in (s.steady, s.scale)]
                hold = "" if s.max_hold is None else f"{number(s.max_hold)} s"
                at = "" if s.at == "departure" else s.at
                rows.append([named(s.name, s.unit), kind, s.topic, s.field, *point, hold, str(s.delay or ""), at])
        header = ("signal", "", "topic", "field", "steady", "scale", "max_hold", "delay", "at")
        said = {name: getattr(self, name) for name in ("clock", "max_gap", "min_step", "max_skew", "step", "additive")}
        below = [f"{name}: {value}" for name, value in said.items() if value not in (None, 0.0, "recorded")]
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
        return cls(**map_arguments(data, source, need_topics))
