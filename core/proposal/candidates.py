# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Candidates: the numbers of topics that could be signals, how clearly they show in the next step, and their roles."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, in_stretches
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import plural, shortlist
from uncertain_lti.identification.evidence import left, size_of
from uncertain_lti.recordings.recording import Recording, usual_step
from uncertain_lti.recordings.table import Table
from uncertain_lti.recordings.table_text import field_name
from uncertain_lti.signals.field_path import FUNCTIONS, of_quaternion
from uncertain_lti.signals.values import TABLE, TABLE_TOPIC

FEWEST = 20
"""Messages that a topic needs, and samples that a signal must leave its usual value in a fortieth of."""

OF_QUATERNION = "|".join(of_quaternion())
"""Functions of a quaternion, as part of a regular expression."""
WRAPPING = "|".join(name for name, function in FUNCTIONS.items() if function.wraps)
"""Functions that give an angle which jumps by a turn, likewise."""


@dataclass(eq=False)
class Candidate:
    """One number of a topic that could be a signal.

    `source`: its topic; `path`: of the number in the message, as `FieldPath` reads it; `values` (messages,): one array
    per recording; NaN where there is none; `name`: of the signal, once it is chosen; `unit`: of the signal; empty where
    it is unknown; `reason`: why it is not proposed; empty if it is, or if there is no reason against it; `ready`:
    `state` or `control` for one that a person may well want back; empty for others; `steady`: steady state, recorded
    units; `scale`: scale, recorded units; `delay`: samples by which the states follow a control later; `ignore`: values
    that stand for none; `why`: why it is proposed; empty where its place in the file says it; `judged`: it is a control
    that is judged as well; `member`: whose an entry of an array without names is, where its effect says so.
    """

    source: Source = field(repr=False)
    path: str
    values: list[Array] = field(default_factory=list, repr=False)
    name: str = ""
    unit: str = ""
    reason: str = ""
    ready: str = ""
    steady: float = 0.0
    scale: float = 1.0
    delay: int = 0
    ignore: tuple[float, ...] = ()
    why: str = ""
    judged: bool = False
    member: str = ""

    @property
    def topic(self) -> str:
        """Name of its topic."""
        return self.source.topic

    @property
    def element(self) -> str:
        """Name of the entry it is (`j0` of `position[j0]`), or ""; one in quotes is not told from an index."""
        match = re.search(r'\[([^\[\]"]+)\]$', self.path)
        return match[1] if match and not match[1].isdigit() else self.member

    @property
    def shape(self) -> str:
        """Path with nothing in the place of the entry that it is."""
        own = f"[{self.element}]"
        return self.path.replace(own, "[]") if own in self.path else re.sub(r"\[\d+\]", "[]", self.path, count=1)

    @property
    def family(self) -> tuple[str, str]:
        """Topic and path without the axis or the number: what the axes of one body and its motors have in common."""
        alike = re.sub(r"(?<=[\w.])[xyz]$", "*", self.path)
        if alike == self.path and re.match(r"(?!data\b)[^\W\d]{2}", self.path.rpartition(".")[2]):
            alike = re.sub(r"\d+", "*", self.path)
        return self.topic, alike

    @property
    def finite(self) -> Array:
        """Its numbers in all recordings."""
        values = np.concatenate([np.empty(0), *self.values])
        return np.asarray(values[np.isfinite(values)])

    @property
    def flickers(self) -> bool:
        """Whether it moves by less than a hundredth of what it is, as a reading's last digits do, and no switch."""
        return bool(np.ptp(self.finite) < 0.01 * np.abs(self.finite).max())

    @property
    def kind(self) -> str:
        """Path without the entry: `position` of `position[j0]`."""
        return self.path.partition("[")[0]


@dataclass(eq=False)
class Source:
    """One topic: its times per recording, what it seems to be, and its numbers.

    `topic`: its name; `type`: message type, `pkg/msg/Type`; `role`: `control`, `reference` (of some controller),
    `state`, empty (unknown), `apart` (neither) or `guess` (a control by its effect); `stamped`: whether header stamps
    can be used; `offset`: median of log time less header stamp, s; None without a stamp; `arrival` (messages,): log
    times per recording, ns; `stamp` (messages,): header stamps per recording, ns; negative for none; `candidates`: its
    numbers; `reason`: why none of them is proposed; empty otherwise; `halting`: its header stamps mostly repeat the one
    before, or are not in every recording; `unreadable`: its messages cannot be read; `apart`: why no state is.
    """

    topic: str
    type: str
    role: str
    stamped: bool
    offset: float | None
    arrival: list[NDArray[np.int64]] = field(default_factory=list, repr=False)
    stamp: list[NDArray[np.int64]] = field(default_factory=list, repr=False)
    candidates: list[Candidate] = field(default_factory=list)
    reason: str = ""
    halting: bool = False
    unreadable: bool = False
    apart: str = ""

    @property
    def count(self) -> int:
        """Messages of all recordings."""
        return sum(len(a) for a in self.arrival)

    @property
    def share(self) -> int:
        """One message in so many is looked at for what shows in what."""
        return 1 + self.count // ENOUGH

    @cached_property
    def rate(self) -> float:
        """Messages per second, by the usual step (`usual_step`), 1/s."""
        steps = np.concatenate([np.zeros(0, np.int64), *map(np.diff, self.arrival)])
        return 1e9 / step if (step := usual_step(steps)[0]) > 0 else 0.0

    def instants(self, clock: Source, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of this topic's messages and another one's by one clock: stamps where both have them, else arrival.

        Returns (messages,): of this topic, ns; Returns (messages,): of the other one, ns.
        """
        if self.stamped and clock.stamped and abs((self.offset or 0.0) - (clock.offset or 0.0)) <= 1.0:
            mine, theirs = self.stamp[number], clock.stamp[number]
            if all(len(s) and s[0] >= 0 and (np.diff(s) >= 0).all() for s in (mine, theirs)):
                return mine, theirs
        return self.arrival[number], clock.arrival[number]

    def parted(self, some: Collection[Candidate], role: str) -> Source:
        """Some of its numbers, which leave it for a topic of their own."""
        mine, arrival, stamp = [c for c in self.candidates if c in some], [*self.arrival], [*self.stamp]
        found = replace(self, candidates=mine, role=role, reason="", arrival=arrival, stamp=stamp)
        self.candidates = [c for c in self.candidates if c not in some]
        for candidate in found.candidates:
            candidate.source = found
        return found

    @property
    def free(self) -> list[Candidate]:
        """Candidates without a reason against them."""
        return [c for c in self.candidates if not c.reason]


SHOWS = 20.0
"""F statistic from which on something counts as visible in the next step."""
FAINT = 5.0
"""F statistic below which a control counts as visible nowhere."""


@dataclass(frozen=True)
class Steps:
    """Transitions of some states, with the controls in force.

    `X` (N, n): states, recorded units; `U` (N, m): controls, recorded units; `dX` (N, n): what the states change by.
    """

    X: Array
    U: Array
    dX: Array

    def effects(self) -> Array:
        """F statistics, in each state's next step, of all controls and of each given the others. Returns (1 + m, n)."""
        (N, n), m = self.X.shape, self.U.shape[1]
        freedom = N - n - m - 1
        if freedom < 5 or not m:
            return np.zeros((1 + m, n))
        scaled = [values / size_of(values) for values in (self.X, self.U)]
        # of a triangle: a regressor explains its coefficient squared over its entry of the inverse Gram matrix
        R: Array = np.asarray(np.linalg.qr(np.hstack([np.ones((N, 1)), *scaled, self.dX]), mode="r"))
        own, explained = R[1 + n : 1 + n + m, 1 + n : 1 + n + m], R[1 + n : 1 + n + m, 1 + n + m :]
        full = (R[1 + n + m :, 1 + n + m :] ** 2).sum(axis=0)
        own[np.diag_indices(m)] += 1e-100 * (np.diagonal(own) == 0.0)
        inverse = np.linalg.inv(own)
        gains = (inverse @ explained) ** 2 / (inverse**2).sum(axis=1)[:, None]
        together = _statistic(full + (explained**2).sum(axis=0), full, self.dX, m, freedom)
        return np.vstack([together, _statistic(full + gains, full, self.dX, 1, freedom)])

    def coupling(self, kept: Sequence[int], rest: Sequence[int]) -> Array:
        """Larger F statistic of each other state in the next step of those kept, and of these in that of the other.

        Given what it is compared with, and the controls. Returns (len(rest),).
        """
        known, more = len(kept) + self.U.shape[1], list(rest)
        freedom = len(self.X) - known - 2
        if freedom < 5:
            return np.zeros(len(more))
        X = self.X / size_of(self.X)
        x, y = left(np.hstack([X[:, kept], self.U]), X[:, more], self.dX[:, kept])
        without = (y**2).sum(axis=0)
        gain = (x.T @ y) ** 2 / np.maximum((x**2).sum(axis=0), 1e-300)[:, None]
        on_kept = _statistic(without, np.maximum(without - gain, 0.0), self.dX[:, kept], 1, freedom)
        x, y, others = left(self.U, X[:, more], self.dX[:, more], X[:, kept])
        without, full = _without(x, y), _without(*left(others, x, y))
        on_rest = _statistic(without, full, self.dX[:, more], len(kept), freedom)
        return np.asarray(np.maximum(on_kept.max(axis=1, initial=0.0), on_rest))


def _statistic(without: Array, full: Array, Y: Array, tested: int, freedom: int) -> Array:
    """F statistic of regressors from the sums of squares that are left of Y (N, k) without and with them."""
    floor = 1e-12 * (Y**2).sum(axis=0) + 1e-300
    return np.asarray(np.maximum(without - full, 0.0) / tested / ((full + floor) / freedom))


def _without(x: Array, y: Array) -> Array:
    """Sum of squares that each column of x (N, k) leaves of the same column of y (N, k)."""
    rest = y - x * ((x * y).sum(axis=0) / np.maximum((x**2).sum(axis=0), 1e-300))
    return np.asarray((rest**2).sum(axis=0))


ENOUGH, _STRETCH = 50_000, 500  # samples that tell what shows in what, in stretches of a long recording


def clock_of(states: Sequence[Candidate]) -> Source:
    """The slowest of the topics of the states."""
    return min((c.source for c in states), key=lambda source: (source.rate, source.topic))


def steps_of(states: Sequence[Candidate], controls: Sequence[Candidate], lags: Sequence[int] = ()) -> Steps:
    """Samples on the messages of the slowest of the states' topics; of the others, the latest message before."""
    lags = lags or [0] * len(controls)
    longest = max(lags, default=0)
    clock = clock_of(states)
    share = clock.share
    found = [tuple(np.empty((0, len(columns))) for columns in (states, controls, states))]
    for number, every in enumerate(clock.arrival):
        rows = np.arange(len(every))
        rows = rows[in_stretches(rows, share, _STRETCH)]
        arrival = every[rows]
        columns = [held(c, number, clock, rows=rows) for c in [*states, *controls]]
        x, u = np.hsplit(np.column_stack(columns), [len(states)])
        step = np.diff(arrival)
        if len(step) < 2 + longest:
            continue
        limit = 2.5 * float(np.median(step[step > 0])) if (step > 0).any() else 0.0
        for j, lag in enumerate(lags):
            u[:, j] = earlier(u[:, j], lag)
        good = (step > 0) & (step <= limit) & ((share == 1) | (rows[:-1] % _STRETCH >= longest))
        good &= np.isfinite(x[:-1]).all(axis=1) & np.isfinite(x[1:]).all(axis=1) & np.isfinite(u[:-1]).all(axis=1)
        found.append((x[:-1][good], u[:-1][good], np.diff(x, axis=0)[good]))
    return Steps(*map(np.concatenate, zip(*found, strict=True)))


def earlier(values: Array, samples: int) -> Array:
    """Each value some samples before, or later (N,); NaN where there is none."""
    if samples < 0:
        return earlier(values[::-1], -samples)[::-1]
    return np.concatenate([np.full(min(samples, len(values)), np.nan), values[: max(len(values) - samples, 0)]])


def held(
    candidate: Candidate, number: int, clock: Source, oldest: float | None = None, rows: Any = slice(None)
) -> Array:
    """Latest value at each message of the clock, or at its `rows`; NaN before the first, and where it is too old."""
    source = candidate.source
    if number >= len(source.arrival) or not len(source.arrival[number]) or number >= len(candidate.values):
        return np.full(len(clock.arrival[number][rows]), np.nan)
    mine, at = source.instants(clock, number)
    at = at[rows]
    position = np.searchsorted(mine, at, side="right") - 1
    values = candidate.values[number][np.maximum(position, 0)]
    age = (at - mine[np.maximum(position, 0)]) * 1e-9
    gone = position < 0 if oldest is None else (position < 0) | (age > oldest)
    return np.where(gone, np.nan, values)


def explained(state: Source, controls: Sequence[Source]) -> float:
    """How clearly some topics show in the next step of the best of a topic's numbers."""
    return most_shown(state.free, [c for s in controls for c in s.free])


def most_shown(states: Sequence[Candidate], controls: Sequence[Candidate]) -> float:
    """How clearly some numbers show in the next step of the best of others."""
    steps = steps_of(states, controls)
    return float(np.max(steps.effects()[0], initial=0.0)) if len(steps.X) >= FEWEST else 0.0


# Words in the name of a topic or of its type; the last word of a name counts most.
_COMMANDS = "cmd|command|input|actuat|throttle|steer|thrust|pwm|pedal|joy|ackermann|trajectory"
_COMMANDS += "|drive(?!n|_?(train|axle|shaft|wheel|end))"  # parts of a machine are none
_COMMAND, _ABOVE = re.compile(f"({_COMMANDS}|contr)"), re.compile(f"({_COMMANDS})")  # a controller publishes all kinds
_COLUMN = re.compile(
    r"^u_?\d*$|^u_(?!dc|zk|bat|netz|bus)|_u$|(^|_)in$|^in_|_in_|(^|_)actions?(_?\d+)?$|clipped|(^|_)(tau(_?(con|calc?))?_?\d*$|duty|(esc|servo).*_[uµ]s$|(rcou_c|raw_servo)\d)|(?<![a-z])(heater|valve|damper|burner)s?(_?\d+)?(_(pct|percent|open(ing)?))?$"
)
_DESIRED = re.compile(r"(^|_)(Des[A-Z]|[A-Z]Des$)")  # as the log of an autopilot spells what its controllers follow
_SET = re.compile(r"(^|_)[Ss]et([A-Z_]|$)")  # a control of a table too, as it is spelt: no Settling
_LABEL = re.compile(
    r"(anomal|attack|att_?flag|(?<!de)fault|label|^class$|change_?point|ground_?truth|is_?normal|"
    r"alarm|emergency|(^|_)e_?stop|protective_?stop|(^|_)(lost|fail(ed|ure)?)$)"
)
_LABELS = 30  # values that a label takes, at most

_REFERENCE = re.compile(
    r"(setpoint|desired|(?<!at_)(target|goal)|referen[cz]|consign[ae]|(^|_)(soll|ziel)|demand|request|(^|_)req(_|$)|ref$|_des(_|\d|$)|"
    r"(^|_)(sp|ref|des)_|_sp$)"
)
_STATE = re.compile(
    r"(state|odom|pose|twist|imu|uwb|vicon|mocap|optitrack|feedback|measur|sensor|encoder|velocity|position|speed|"
    r"depth|pressure|temperature|power|attitude|estimat|log|loc$|response|data$|(^|_)mag(net|_|$)|compass|transform)"
)
_FORCE, _ESC = re.compile(r"thrust.*_(g|gf|kgf?|k?n|lbf?)$"), re.compile(r"throttle|pwm|(^|_)esc(_|$)")  # on a stand
_ANSWER = re.compile(r"(state|states|status|report|feedback|response|actual|odom|odometry)$|meas(ur|_|\d|$)|estimat")
_APART = re.compile(
    r"(battery|leak|diagnos|health|rosout|event|tf$|tf_static|camera|image|map$|marker|gps(?!.*(speed|vel|sog))|fix$)"
)
_FOLLOWED = re.compile(r"setpoint[^/]*/|/rc/(in|override)$")  # topics below a folder, and what a pilot's sticks say
_SENT = re.compile(
    r"(^|/)(commands?|cmds?)/|(^|/)(cmd|set)_(?!.*(feedback|response|actual|report|status|odom))[^/]*$|/rc/out$|"
    r"(^|[/_])(duty|ailerons?|elevons?|elevators?|rudders?)(_angle)?$"
)
_MEASURED = re.compile(r"(^|_)(rpm|altimeter|level|vels?|flow|current|voltage|temp|tacho\w*)(_|$)")
_TOLD = re.compile(
    r"^err|error|(^|_)(acc(eleration)?(_?[xyz])?|adc\d*|alt(itude)?|heading|height|humidity|soc|volt(age)?|current|efficiency|vibration|pos|flags)(_|$)"
)
"""Likewise, of what is measured or reckoned, in the names of columns."""

_PHYSICAL = re.compile(
    r"^(imu|jointstate|odometry|twist|pose|wrench|accel|vector3|quaternion|transformstamped|ackermann)"
)

_APART_TYPES = {
    "rcl_interfaces/msg/Log", "rcl_interfaces/msg/ParameterEvent", "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock",
    "diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus", "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image", "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path",
    "visualization_msgs/msg/Marker", "visualization_msgs/msg/MarkerArray",
}  # fmt: skip


def is_physical(type_name: str) -> bool:
    """Whether messages of a type hold how a body or a joint is and moves."""
    return bool(_PHYSICAL.search(type_name.rpartition("/")[2].lower()))


def role_by_name(topic: str, type_name: str) -> str:
    """What a topic seems to be by its name, the last word first, else by its type."""
    if type_name in _APART_TYPES:
        return "apart"
    name = topic.strip("/").lower()
    last = name.rpartition("/")[2]
    kind = type_name.rpartition("/")[2].lower()
    if not is_physical(type_name) and any(_APART.search(text) for text in (last, name)):
        return "apart"
    if _FOLLOWED.search(name):
        return "reference"
    if _SENT.search(name) and (last.startswith("cmd_") or not _ANSWER.search(last)):
        return "control"
    for text in (last, name, kind):
        if _ANSWER.search(text):
            return "state"
        if _REFERENCE.search(text):
            return "reference"
        bare_twist = text == last and (text.startswith("u_") or (kind == "twist" and text.endswith("vel")))  # of a base
        if bare_twist or (_ABOVE if text == name != last else _COMMAND).search(text):
            return "control"
        if _STATE.search(text) or _MEASURED.search(text):
            return "state"
    return ""


_FIELDS = {
    "reference": _REFERENCE,
    "control": re.compile(r"^(command(ed)?|cmd)(_|$)|^(output|controls?)$|_(command(ed)?|cmd)$"),
    "error": re.compile(r"(^|_)err(or)?$|^err(or)?_|^[pid]_term$"),
}
"""Parts of a field's path by which it is no measurement, beside others that are."""


def part_by_role(source: Source) -> list[Source]:
    """What of a topic's numbers is no measurement leaves it: what a controller follows, and what it puts out."""
    plain = {c: re.sub(r"\[[^\]]*\]", "", c.path).replace("set_point", "setpoint") for c in source.free}
    words = {c: re.findall(r"[^\W\d]\w*", path) for c, path in plain.items()}
    every = {word for some in words.values() for word in some}
    found: dict[str, list[Candidate]] = {role: [] for role in _FIELDS}
    for candidate, some in words.items():
        desired = any(w.endswith("_d") and w[:-2] in every for w in some)
        role = next((r for r, name in _FIELDS.items() if any(map(name.search, some))), "reference" if desired else "")
        if role:
            found[role].append(candidate)
    errors = found.pop("error")
    if sum(map(len, found.values())) in (0, len(words)):  # a topic of nothing else is told by its name
        return []
    for candidate in errors:
        candidate.reason = "a controller's error, or part of its answer to it"
    source.role = "state"  # beside what is commanded it is told what came of it, whatever the topic is called
    return [source.parted(some, role) for role, some in found.items() if some]


_BODY = {"u", "v"}, {"w", "p", "q", "r"}
"""Velocities of a body in its own frame: where both of the first and one of the others are columns, u is no control."""
_CHANNEL = re.compile(r"(throttle|aileron|elevator|rudder|elevon|flap)s?(_?\w{1,2})?")
"""Of an aircraft: where two of these are columns, no elevator is that of a building."""
_OF_CABINET = re.compile(r"control(ler)?_(module|unit|box|board|panel|cabinet)_|controller_temp")
_EFFECTOR = re.compile(r"(delta|rudder|aileron|elevator|flap|fin|sail|prop(eller)?|n|n_?prop|rpm)(_?\w{1,2})?")


def bare(name: str) -> str:
    """Name of a column without capitals and the unit of a speed."""
    return re.sub(r"_(m|rad|deg)_s$", "", name.lower())


def role_of_column(name: str, beside: Collection[str] = ()) -> str:
    """What a column of a table seems to be by its name, and those `beside` it, as `bare` gives them."""
    low = bare(name.partition("[")[0])
    if (outlet := re.sub(r"(^|_)in(?=_|$)", r"\1out", low)) != low and outlet in beside:
        return "state"
    if _BODY[0].issubset(beside) and not _BODY[1].isdisjoint(beside):
        if low in _BODY[0] or _EFFECTOR.fullmatch(low):
            return "state" if low in _BODY[0] else "control"
    if _CHANNEL.fullmatch(low) and len({m[1] for b in beside if (m := _CHANNEL.fullmatch(b))}) > 1:
        return "control"
    if _OF_CABINET.search(low) and not _REFERENCE.search(low):
        return "state"
    phases = {re.sub(r"(?<!^u)_u(?=_|$)", f"_{other}", low) for other in "vw"}
    if len(phases) == 2 and phases.issubset(beside):  # i_u, i_v and i_w, and no input
        return "state"
    if low[:1] == "u" and "y" + low[1:] in beside:  # of an experiment's input and output
        return "control"
    loop = {b for b in beside if "setpoint" in b and b.replace("setpoint", "input") in beside}  # of a PID's log
    if "input" in low and low.replace("input", "setpoint") in loop:
        return "state"
    if low.endswith("output") and (loop or {"setpoint", "error"}.issubset(beside)):
        return "control"
    if _ANSWER.search(low) or (_FORCE.search(low) and any(map(_ESC.search, beside))):
        return "state"
    followed = _REFERENCE.search(low) or _DESIRED.search(name)
    if followed or (low == "r" and {"u", "y"}.issubset(beside) and {"v", "x", "p"}.isdisjoint(beside)):
        return "reference"
    return "control" if _COMMAND.search(low) or _COLUMN.search(low) or _SET.search(name) else "state"


READ = re.compile(r"temperature|humidity|pressure|voltage|current(_?\w{1,2})?$")
"""What is measured by its name, also where a sensor gives whole numbers and few of them."""
TWO_VALUES = "takes two values only"
"""Why a measurement is no state; in a table it may be a switch."""


def is_measured(name: str) -> bool:
    """Whether a column says by its name that it is measured, or reckoned, and no command."""
    return any(named.search(name.lower()) for named in (_STATE, _APART, _TOLD))


def is_label(name: str) -> bool:
    """Whether a column says by its name what people hold of a row."""
    return _LABEL.search(name.lower()) is not None


def set_aside_labels(sources: Sequence[Source], bags: Sequence[Recording]) -> list[str]:
    """Leave out columns of tables that are labels by their names; a warning for each that does not stay the same."""
    columns: dict[str, Counter[object]] = {}
    for table in (bag for bag in bags if isinstance(bag, Table)):
        for name, column in table.columns_by_field.items():
            if is_label(name):
                values = [v for v in column.ravel().tolist() if v not in ("", None) and v == v]
                columns.setdefault(name, Counter()).update(values)
    warnings = []
    few = {name: counts for name, counts in columns.items() if len(counts) <= _LABELS}  # no angle of attack
    for name, counts in few.items():
        for candidate in (c for s in sources if s.type == TABLE for c in s.candidates):
            if candidate.kind == name:
                candidate.reason = "a label by its name, and no signal of the machine"
        if len(counts) > 1:
            usual, number = counts.most_common(1)[0]
            usual, of = f"{usual:.6g}" if isinstance(usual, float) else usual, plural(counts.total() - number, "row")
            remedy = "leave out of the recordings what was not healthy, as a fit takes all of them for healthy"
            warnings.append(f"{name} looks like a label, and is not {usual} in {of}: {remedy}")
    return warnings


_CODE = re.compile(r"(^|[_.])(mode|modus|status|state|flag|gear|phase|step|schritt)(_?\d+)?$")
"""Name of a number that, with whole numbers up to `_LABELS` of them, says what a machine was switched to."""


_NO_AMOUNTS = "a code by its name, and its numbers are no amounts"


def _is_code(candidate: Candidate) -> bool:
    values = np.unique(candidate.finite) if _CODE.search(candidate.path.lower()) else np.empty(0)
    return 0 < len(values) <= _LABELS and bool((values == np.rint(values)).all())


def take_switches(sources: Sequence[Source]) -> list[Source]:
    """Columns of tables that are switched, which leave the measurements and may be controls; codes are no states."""
    found, driven = [], any(s.role == "control" and s.free for s in sources)
    for candidate in (c for s in sources if s.type != TABLE and s.role in ("state", "") for c in s.free if _is_code(c)):
        candidate.reason, candidate.ready = _NO_AMOUNTS, "control"
    for table in (s for s in sources if s.type == TABLE and s.role == "state"):
        codes = [c for c in table.free if _is_code(c)]
        for candidate in codes * driven:  # else it may be the only control
            candidate.reason, candidate.ready = _NO_AMOUNTS, "control"
        two = [c for c in table.candidates if c.reason == TWO_VALUES and not READ.search(c.path.lower())]
        if turned := codes * (not driven) + [c for c in two if not c.flickers]:
            found.append(table.parted(turned, "switch"))
        for candidate in turned:
            candidate.reason = ""
    return found


def at_rest(sources: Sequence[Source]) -> str:
    """What to say of recordings in which there are commands and none of them moves."""
    commands = [s for s in sources if s.role == "control" and s.count and s.candidates]
    if not commands or any(s.free for s in commands):
        return ""
    still = shortlist([f"{s.topic} {c.path} {c.reason}" for s in commands for c in s.candidates[:1]], 3)
    held = any(c.finite.any() for s in commands for c in s.candidates)
    rest = "what it does to the states cannot be told" if held else "the machine is at rest"
    return (
        f"no command moves ({still}): {rest}, and what is proposed drifts or is disturbed; record the machine at work"
        f"{', with other commands,' * held} before you fit a model"
    )


def ask_for(sources: list[Source], states: Sequence[str], controls: Sequence[str], where: str) -> None:
    """Give the roles that a person asks for in place of those by name; a source that has both is split in two."""
    states, controls = ([_with_topic(pattern, sources) for pattern in patterns] for patterns in (states, controls))
    asked, met = {"state": states, "control": controls}, {"state": set[Candidate](), "control": set[Candidate]()}
    every = [(s, c) for s in sources for c in s.candidates]
    for role, pattern in ((role, pattern) for role, patterns in asked.items() for pattern in patterns):
        topic, path = (one or "*" for one in _plain(pattern).partition(":")[::2])
        found = [c for s, c in every if fnmatchcase(s.topic, topic) and fnmatchcase(_plain(c.path), path)]
        if not any(not c.reason for c in found):
            why = f"; topics there: {shortlist(list(dict.fromkeys(s.topic for s in sources)), 20)}"
            if found:
                why = f"; {found[0].path} is {found[0].reason}"
            elif fields := [f"{s.topic}:{c.path}" for s, c in every if pattern == c.path]:
                why = f"; a field is asked for with its topic, {' or '.join(fields[:3])}"
            raise BagError(f"{where}: --{role}s {pattern} meets nothing that moves{why}")
        if role == "state" and path == "*":  # of topics, what is measured by its name, if anything is
            found = [c for c in found if c.source.role not in ("control", "reference")] or found
        met[role].update(found)
    fewer, more = sorted(met, key=lambda role: len(met[role]))
    met[more] -= met[fewer]
    for source in list(sources):
        mine, others = (met[role].intersection(source.candidates) for role in ("control", "state"))
        of_field = any(":" in pattern for pattern in controls) and source.role == "state" and not states
        if mine and (others or (of_field and mine != {*source.candidates})):  # one of what is measured is asked for
            sources.append(source.parted(mine, "control"))
    for source in sources:
        for role, patterns in asked.items():
            mine, why = met[role].intersection(source.candidates), f"not asked for by --{role}s"
            if mine:
                source.role, source.reason = role, ""
            elif patterns and source.role == role:
                source.role, source.reason = "apart", source.reason or why
            else:
                continue
            for candidate in source.free:
                if candidate not in mine:
                    candidate.reason = source.reason or why


def _with_topic(pattern: str, sources: Sequence[Source]) -> str:
    """What is asked for, with the topic of tables if it is a column, by its name as a field or in the file."""
    if any(fnmatchcase(s.topic, pattern.partition(":")[0]) for s in sources):
        return pattern
    columns = [_plain(c.path) for s in sources if s.type == TABLE for c in s.candidates]
    names = (n for n in (pattern, field_name(pattern)) if any(fnmatchcase(c, _plain(n)) for c in columns))
    return next((f"{TABLE_TOPIC}*:{name}" for name in names), pattern)


def _plain(path: str) -> str:
    """A field path without what a pattern would take for a choice of letters."""
    return path.replace("[", "(").replace("]", ")")
