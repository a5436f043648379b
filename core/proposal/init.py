"""Proposal: a signals file suggested from what a recording holds, for a person to edit."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, shortlist
from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.identification.noise import NOISE, predicted
from uncertain_lti.identification.sensors import LONGEST_DELAY, lags
from uncertain_lti.recordings.bag import Bag, TopicFacts, describe, group_recordings
from uncertain_lti.recordings.bag_arrays import read_columns
from uncertain_lti.recordings.cdr_arrays import RepeatedNamesError
from uncertain_lti.sampling.operating_point import resolve_auto
from uncertain_lti.signals.signal_map import FieldPath, Signal

Iterate = Callable[[Iterable[object], int], Iterable[object]]

FEWEST = 20
"""Messages that a topic needs, and samples that a signal must leave its usual value in a fortieth of."""
LONGEST_ARRAY = 24
"""Entries of an array that are looked at one by one; a longer one is a picture, a scan or a map."""
MOST_VALUES = 50_000_000
"""Numbers read at most; fields beyond are listed and not looked at."""
SHOWS = 20.0
"""F statistic from which on something is said to show in the next step."""
FAINT = 5.0
"""F statistic below which a control is said to show nowhere."""
PER_UNKNOWN = 20
"""Transitions per signal below which further signals are only listed."""
MOST_STATES, MOST_CONTROLS = 8, 6
SHORT_DELAY = 3
"""Samples within which a control shows that keeps a state from being noise."""

# Words in the name of a topic or of its type; the last word of a name counts most.
_COMMAND = re.compile(r"(cmd|command|contr|input|actuat|throttle|steer|thrust|pwm|joy|ackermann|drive|trajectory)")
_WISH = re.compile(r"(setpoint|desired|target|goal|reference|demand|ref$)")
_STATE = re.compile(
    r"(state|odom|pose|twist|imu|vicon|mocap|optitrack|feedback|measur|sensor|encoder|velocity|position|speed|"
    r"depth|pressure|temperature|power|attitude|estimat|log|response|data$)"
)
_ANSWER = re.compile(r"(state|states|feedback|response|actual|odom|odometry)$|measur|estimat")
_APART = re.compile(r"(battery|leak|diagnos|health|rosout|event|tf$|tf_static|camera|image|map$|marker|gps|fix$)")
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
_SPREAD = re.compile(r"\[(\d+)\.\.(\d+)\]")
_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_DULL = {"pose", "twist", "vector", "data", "point", "transform", "msg", "value", "quaternion", "accel", "wrench"}
_UNITS = (
    (re.compile(r"(roll|pitch|yaw)\("), "rad"),
    (re.compile(r"angular_velocity\.|twist\.angular\.|(^|\.)angular\.[xyz]$"), "rad/s"),
    (re.compile(r"linear_acceleration\."), "m/s^2"),
    (re.compile(r"(^|\.)linear\.[xyz]$"), "m/s"),
    (re.compile(r"pose\.position\.|translation\."), "m"),
    (re.compile(r"fluid_pressure$"), "Pa"),
)


@dataclass
class Candidate:
    """One number of a topic that could be a signal.

    values, one array (messages,) per recording, NaN where there is none; reason says why it is not proposed ("" where
    it is, or nothing speaks against it); ready is "state" or "control" for one that a person may well want back; delay
    is by how many samples the states follow a control later.
    """

    topic: str
    path: str
    values: list[Array] = field(default_factory=list, repr=False)
    name: str = ""
    unit: str = ""
    reason: str = ""
    ready: str = ""
    steady: float = 0.0
    scale: float = 1.0
    delay: int = 0

    @property
    def element(self) -> str:
        """Name of the entry it is (`j0` of `position[j0]`), or ""."""
        match = re.search(r'\["?([^\[\]"]+)"?\]$', self.path)
        return match[1] if match and not match[1].isdigit() else ""

    @property
    def kind(self) -> str:
        """Path without the entry: `position` of `position[j0]`."""
        return self.path.partition("[")[0]


@dataclass
class Source:
    """One topic: times of arrival and stamps in ns per recording, what it seems to be, and its numbers.

    role is "control", "wish" (a reference of some controller), "state", "" (unknown) or "apart" (neither). halting: its
    header stamps mostly stand still.
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

    @property
    def count(self) -> int:
        """Messages of all recordings."""
        return sum(len(a) for a in self.arrival)

    @property
    def rate(self) -> float:
        """Messages per second while there are any, 1/s."""
        span = sum(float(a[-1] - a[0]) for a in self.arrival if len(a) > 1) * 1e-9
        return sum(len(a) - 1 for a in self.arrival if len(a) > 1) / span if span > 0 else 0.0

    def instants(self, clock: Source, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of this topic's messages and another one's by one clock: stamps where both have them, else arrival."""
        if self.stamped and clock.stamped and abs((self.offset or 0.0) - (clock.offset or 0.0)) <= 1.0:
            mine, theirs = self.stamp[number], clock.stamp[number]
            if all(len(s) and s[0] >= 0 and (np.diff(s) >= 0).all() for s in (mine, theirs)):
                return mine, theirs
        return self.arrival[number], clock.arrival[number]

    @property
    def free(self) -> list[Candidate]:
        """Candidates that nothing speaks against."""
        return [c for c in self.candidates if not c.reason]


@dataclass(frozen=True)
class Proposal:
    """States and controls of a machine, as far as a recording tells; `text` is the signals file, with its reasons."""

    states: tuple[Candidate, ...]
    controls: tuple[Candidate, ...]
    text: str
    warnings: tuple[str, ...] = ()


def propose(paths: Sequence[str | os.PathLike[str]], progress: Iterate | None = None) -> Proposal:
    """Suggest states and controls of a machine from recordings of it.

    Topics are told apart by their names and types, and where these say nothing by what helps to predict what; of a
    topic's numbers those are proposed that move, and in whose next step the controls show, or which help to predict
    such ones. Everything else is listed in comments with the reason.

    Parameters
    ----------
    paths : sequence of path
        As for `read_transients`.
    progress : callable, optional
        As for `read_transients`.

    Raises
    ------
    BagError
        A recording cannot be read, or holds nothing that could be a state.
    """
    bags = group_recordings(list(paths))
    if not bags:
        raise BagError("no recording is named; give at least one MCAP file or folder")
    sources = _look(bags, progress)
    controls, states = _roles(sources)
    if not states:
        said = "; ".join(f"{s.topic}: {s.reason or 'a command by its name'}" for s in sources[:8])
        raise BagError(f"{bags[0].path}: nothing in it looks like the state of a machine ({said or 'no topics'})")
    chosen, doubt = _choose(states, controls)
    used = [c for s in controls for c in s.free]
    ready = [c for s in sources for c in s.candidates if c.ready]
    _name([*chosen, *(c for c in ready if c.ready == "state")], [*used, *(c for c in ready if c.ready == "control")])
    _operating_point(chosen, used, sources)
    for candidate in ready:
        _own_scale(candidate)
    warnings = (*(warning for bag in bags for warning in bag.warnings), *([doubt] if doubt else []))
    return Proposal(tuple(chosen), tuple(used), _text(bags, sources, chosen, used, doubt), warnings)


# --- looking ----------------------------------------------------------------------------------------------------


def _look(bags: Sequence[Bag], progress: Iterate | None) -> list[Source]:
    """Every topic of the recordings with its numbers."""
    facts: dict[str, TopicFacts] = {}
    for bag in bags:
        for fact in describe(bag, progress):
            known = facts.get(fact.info.topic)
            if known is None or (not known.fields and fact.fields):
                facts[fact.info.topic] = fact
    sources = []
    for topic, fact in facts.items():
        stamped = fact.stamps in ("usable", "mixed")
        source = Source(topic, fact.info.type, _role(topic, fact.info.type), stamped, fact.stamp_offset)
        sources.append(source)
        total = sum(bag.topics[topic].count for bag in bags if topic in bag.topics)
        if not fact.info.readable:
            source.reason = fact.info.reason
        elif source.role == "apart":
            source.reason = "no signal of a machine by its name or type"
        elif total < (3 if source.role == "control" else FEWEST):
            source.reason = f"{plural(total, 'message')} only"
        elif any(topic not in b.topics or not b.topics[topic].count for b in bags):
            source.reason = "not in every recording"
        elif any(b.topics[topic].type != fact.info.type for b in bags):
            source.reason = "of different types in these recordings"
        else:
            source.candidates = _candidates(topic, fact.fields)
            if not source.candidates:
                source.reason = "no number in it"
        if source.reason:
            source.candidates = []
    _limit(bags, sources)
    for bag in bags:
        _read(bag, [s for s in sources if s.candidates], progress)
    for source in sources:
        if source.candidates and not source.rate > 0:
            source.reason, source.candidates = "no time passes between its messages", []
        _sift(source)
    return sources


def _limit(bags: Sequence[Bag], sources: Sequence[Source]) -> None:
    """Look at no more numbers than memory holds: commands first, then states, from the first field on."""
    order = ("control", "state", "wish", "")
    left = MOST_VALUES
    for source in sorted((s for s in sources if s.candidates), key=lambda s: order.index(s.role)):
        count = max(1, sum(bag.topics[source.topic].count for bag in bags))
        for candidate in source.candidates:
            if candidate.reason:
                continue
            left -= count
            if left < 0:
                candidate.reason = "not looked at, the recordings are too large: propose from a shorter one"


def _role(topic: str, type_name: str) -> str:
    """What a topic seems to be by its name, the last word first, else by its type."""
    if type_name in _APART_TYPES:
        return "apart"
    name = topic.strip("/").lower()
    last = name.rpartition("/")[2]
    kind = type_name.rpartition("/")[2].lower()
    if not _PHYSICAL.search(kind) and any(_APART.search(text) for text in (last, name)):
        return "apart"
    for text in (last, name, kind):
        if _ANSWER.search(text):
            return "state"
        if _WISH.search(text):
            return "wish"
        if _COMMAND.search(text):
            return "control"
        if text == last and kind == "twist" and text.endswith("vel"):
            return "control"  # a bare Twist is what drives a base
        if _STATE.search(text):
            return "state"
    return ""


def _candidates(topic: str, fields: Sequence[str]) -> list[Candidate]:
    """Paths as they would stand in a file; arrays entry by entry, long ones once with the reason."""
    found: list[Candidate] = []
    for path in fields:
        size = math.prod(int(b) - int(a) + 1 for a, b in _SPREAD.findall(path))
        if re.search(r"(covariance|variance)", path):
            continue
        if size > LONGEST_ARRAY:
            found.append(Candidate(topic, path, reason=f"an array of {size} numbers"))
            continue
        every = [path]
        while any(_SPREAD.search(p) for p in every):
            every = [
                p[: match.start()] + f"[{i}]" + p[match.end() :]
                for p in every
                if (match := _SPREAD.search(p))
                for i in range(int(match[1]), int(match[2]) + 1)
            ]
        found += [Candidate(topic, p) for p in every]
    return found


def _read(bag: Bag, sources: Sequence[Source], progress: Iterate | None) -> None:
    """Values of every candidate in one recording."""
    for source in sources:
        readable = [c for c in source.candidates if not c.reason]
        paths = [FieldPath(c.path) for c in readable]
        try:
            columns = read_columns(bag, [source.topic], [paths], progress)
            arrival, stamp, values = columns.arrival, columns.stamp, columns.values[0]
            stamps = columns.stamp[columns.stamp >= 0]
            if len(stamps) > 1 and np.count_nonzero(np.diff(stamps) > 0) < 0.5 * (len(arrival) - 1):
                source.halting = True
        except (RepeatedNamesError, SignalError):
            read = [(t, [path.read(message) for path in paths]) for _, t, message in bag.messages([source.topic])]
            arrival = np.array([t for t, _ in read], dtype=np.int64)
            values = np.array([row for _, row in read], dtype=np.float64).reshape(len(read), len(paths))
            stamp = np.full(len(arrival), -1, dtype=np.int64)
        source.arrival.append(arrival)
        source.stamp.append(stamp)
        for column, candidate in zip(values.T, readable, strict=True):
            candidate.values.append(column)


def _sift(source: Source) -> None:
    """Say of each number whether it moves; angles in place of the quaternions that are some."""
    if not source.candidates:
        return
    bases = {m[2] for c in source.candidates if (m := re.fullmatch(r"(roll|pitch|yaw)\((.+)\)", c.path))}
    parts = {c.path: c for c in source.candidates}
    for base in bases:
        raw = [parts.get(f"{base}.{axis}") for axis in "xyzw"]
        read = [r for r in raw if r is not None and r.values]
        norm = np.sqrt(sum(np.concatenate(r.values) ** 2 for r in read)) if len(read) == 4 else np.zeros(1)
        unit = np.abs(norm[np.isfinite(norm)] - 1.0) < 0.02
        is_rotation = len(unit) > 0 and unit.mean() > 0.9
        for candidate in source.candidates:
            of_base = candidate.path.startswith(f"{base}.") or candidate.path.endswith(f"({base})")
            if of_base and candidate.path.endswith(f"({base})") != is_rotation:
                candidate.reason = "|"  # said by the other form of the same numbers; not worth a line
    source.candidates = [c for c in source.candidates if c.reason != "|"]
    for candidate in source.candidates:
        if not candidate.reason:
            _judge(candidate, source)
    _wrapped(source)
    if all(c.reason for c in source.candidates):
        source.reason = "; ".join(f"{c.path} {c.reason}" for c in source.candidates[:3])
        source.reason += f" and {len(source.candidates) - 3} more" * (len(source.candidates) > 3)


def _judge(candidate: Candidate, source: Source) -> None:
    if not candidate.values:
        candidate.reason = "not read"
        return
    values = np.concatenate(candidate.values)
    finite = values[np.isfinite(values)]
    if not len(finite):
        candidate.reason = "never a number"
    elif finite.min() == finite.max():
        candidate.reason = f"always {finite[0] + 0.0:.6g}"
    elif len(finite) < 0.5 * len(values):
        candidate.reason = f"a number in {len(finite)} of {len(values)} messages only"
    elif (moved := len(finite) - int(np.unique(finite, return_counts=True)[1].max())) < max(3, len(finite) // 500):
        candidate.reason = f"leaves its usual value in {moved} of {plural(len(finite), 'message')} only"
    elif source.role == "state" and len(np.unique(finite)) < 3:
        candidate.reason = "takes two values only"
    elif source.role != "control" and _counts(values, np.concatenate(source.arrival)):
        candidate.reason = "grows as a clock or a counter does"
    elif max(abs(float(finite.min())), abs(float(finite.max()))) > 1e15:
        candidate.reason = "holds numbers beyond 1e15"


def _counts(values: Array, arrival: NDArray[np.int64]) -> bool:
    """Never falls, and is a whole number or goes by the time of arrival."""
    good = np.isfinite(values)
    finite, t = values[good], (arrival[good] - arrival[0]) * 1e-9
    if len(finite) < 3 or (np.diff(finite) < 0).any() or len(np.unique(finite)) < 0.5 * len(finite):
        return False
    if (finite == np.rint(finite)).all():
        return True
    rest = _residual(t[:, None], finite[:, None])[0]
    return bool(rest < (0.002 * np.ptp(finite)) ** 2 * len(finite))


def _wrapped(source: Source) -> None:
    """Angles that jump by a turn are unwrapped, those of a quaternion always."""
    for candidate in source.candidates:
        if candidate.reason:
            continue
        angle = re.match(r"(roll|yaw)\(", candidate.path) is not None
        jumps = 0
        for values in candidate.values:
            finite = values[np.isfinite(values)]
            if len(finite) and np.ptp(finite) <= 2.2 * np.pi:
                jumps += int((np.abs(np.diff(finite)) > 1.6 * np.pi).sum())
        if angle or (jumps and re.search(r"(angle|yaw|heading|roll|theta|phi|psi|azimuth|course)", candidate.path)):
            candidate.path = f"unwrap({candidate.path})"
            candidate.values = [_unwrapped(v) for v in candidate.values]


def _unwrapped(values: Array) -> Array:
    finite = np.isfinite(values)
    out = values.copy()
    out[finite] = np.unwrap(values[finite])
    return out


# --- choosing ---------------------------------------------------------------------------------------------------


def _roles(sources: Sequence[Source]) -> tuple[list[Source], list[Source]]:
    """Topics of the controls, and those that may be the state."""
    moving = [s for s in sources if s.free]
    controls = [s for s in moving if s.role == "control"]
    wishes = [s for s in moving if s.role == "wish"]
    if not controls:
        controls, wishes = wishes, []
    for source in wishes:
        source.reason = "a reference for some controller, and there is a command"
    states = [s for s in moving if s.role == "state"]
    unknown = [s for s in moving if s.role == ""]
    if not states:
        states, unknown = unknown, []
    if not states and len(controls) > 1:  # commands everywhere by their names: the one that the others explain best
        best = max(controls, key=lambda s: _explained(s, [c for c in controls if c is not s]))
        controls, states = [c for c in controls if c is not best], [best]
    if not controls and len(states) + len(unknown) > 1:
        by_effect = max(
            (s for s in [*unknown, *states] if len(states) > 1 or s not in states),
            key=lambda s: max((_explained(o, [s]) for o in states if o is not s), default=0.0),
            default=None,
        )
        if by_effect is not None and max(_explained(o, [by_effect]) for o in states if o is not by_effect) > SHOWS:
            by_effect.role = "guess"
            controls, states = [by_effect], [s for s in states if s is not by_effect]
            unknown = [s for s in unknown if s is not by_effect]
    for source in unknown:
        source.reason = "neither state nor control by its name or type"
    return controls, states


@dataclass(frozen=True)
class _Steps:
    """Transitions of some states X (N, n) with the controls U (N, m) in force, and what changed, dX (N, n)."""

    X: Array
    U: Array
    dX: Array

    def effect(self, on: Sequence[int], of: Sequence[int] | None = None, given: Sequence[int] | None = None) -> Array:
        """F statistic (len(on),) in the next step of states `on`: of the controls, or of states `of`.

        Beside states `given` (default all), and beside the controls where these are not what is asked for.
        """
        n, m = self.X.shape[1], self.U.shape[1]
        tested = list(range(n, n + m)) if of is None else list(of)
        beside = [j for j in (range(n) if given is None else given) if j not in tested]
        if of is not None:
            beside += range(n, n + m)
        Z, Y = np.hstack([self.X, self.U]), self.dX[:, list(on)]
        freedom = len(Z) - len(beside) - len(tested) - 1
        if freedom < 5 or not tested:
            return np.zeros(len(on))
        without, full = _residual(Z[:, beside], Y), _residual(Z[:, [*beside, *tested]], Y)
        floor = 1e-12 * (Y**2).sum(axis=0) + 1e-300
        gain = np.maximum(without - full, 0.0) / len(tested)
        return np.asarray(gain / ((full + floor) / freedom))


def _residual(Z: Array, Y: Array) -> Array:
    """Sum of squares (k,) that a least-squares fit of Y (N, k) on [1, Z] leaves."""
    size = np.maximum(np.abs(Z).max(axis=0, initial=0.0), 1e-300)
    design = np.hstack([np.ones((len(Z), 1)), Z / size])
    Q, _ = np.linalg.qr(design)
    rest = Y - Q @ (Q.T @ Y)
    return np.asarray((rest**2).sum(axis=0))


def _steps(
    state: Sequence[Candidate], of: dict[str, Source], controls: Sequence[Candidate], lags: Sequence[int] = ()
) -> _Steps:
    """Samples on the messages of the slowest of the states' topics; of the others, the latest message before.

    lags: by how many samples each control is taken earlier; none by default.
    """
    lags = lags or [0] * len(controls)
    longest = max(lags, default=0)
    topics = list(dict.fromkeys(c.topic for c in state))
    clock = min(topics, key=lambda t: of[t].rate)
    X, U, dX = [], [], []
    for number, arrival in enumerate(of[clock].arrival):
        x = np.column_stack([_held(c, of[c.topic], number, of[clock]) for c in state])
        u = (
            np.column_stack([_held(c, of[c.topic], number, of[clock]) for c in controls])
            if controls
            else np.empty((len(arrival), 0))
        )
        step = np.diff(arrival)
        if len(step) < 2 + longest:
            continue
        positive = step[step > 0]
        limit = 2.5 * float(np.median(positive)) if len(positive) else 0.0
        for j, lag in enumerate(lags):
            u[:, j] = np.concatenate([np.full(lag, np.nan), u[: len(u) - lag, j]])
        good = (step > 0) & (step <= limit)
        good &= np.isfinite(x[:-1]).all(axis=1) & np.isfinite(x[1:]).all(axis=1) & np.isfinite(u[:-1]).all(axis=1)
        if len(good) > 200_000:  # enough to tell
            good[200_000:] = False
        X.append(x[:-1][good])
        U.append(u[:-1][good])
        dX.append(np.diff(x, axis=0)[good])
    n, m = len(state), len(controls)
    return _Steps(
        np.concatenate([np.empty((0, n)), *X]),
        np.concatenate([np.empty((0, m)), *U]),
        np.concatenate([np.empty((0, n)), *dX]),
    )


def _held(candidate: Candidate, source: Source, number: int, clock: Source, oldest: float | None = None) -> Array:
    """Latest value at each message of the clock; NaN before the first, and where it is older than `oldest` s."""
    if number >= len(source.arrival) or not len(source.arrival[number]) or number >= len(candidate.values):
        return np.full(len(clock.arrival[number]), np.nan)
    mine, at = source.instants(clock, number)
    position = np.searchsorted(mine, at, side="right") - 1
    values = candidate.values[number][np.maximum(position, 0)]
    age = (at - mine[np.maximum(position, 0)]) * 1e-9
    gone = position < 0 if oldest is None else (position < 0) | (age > oldest)
    return np.where(gone, np.nan, values)


def _explained(state: Source, controls: Sequence[Source]) -> float:
    """How clearly these topics show in the next step of the best of a topic's numbers."""
    every = {s.topic: s for s in [state, *controls]}
    steps = _steps(state.free, every, [c for s in controls for c in s.free])
    if len(steps.X) < FEWEST:
        return 0.0
    return float(np.max(steps.effect(range(len(state.free))), initial=0.0))


def _choose(states: Sequence[Source], controls: Sequence[Source]) -> tuple[list[Candidate], str]:
    """States of the model, and a sentence where they look like none; reasons go to what is left out."""
    every = {s.topic: s for s in [*states, *controls]}
    for source in states:
        _prefer_rates(source)
    shown = [s for s in states if not controls or _explained(s, controls) > SHOWS] or list(states)
    main = max(shown, key=lambda s: (s.rate, s.count))
    pool = list(main.free)
    for source in states:
        if source is main:
            continue
        if source in shown and 0.8 * main.rate <= source.rate <= 1.25 * main.rate:
            pool += source.free
        else:
            source.reason = (
                f"{source.rate:.3g} messages a second beside {main.rate:.3g} of {main.topic}"
                if source in shown
                else "the controls do not show in it"
            )
    _same(pool)
    pool = [c for c in pool if not c.reason]
    used = [c for s in controls for c in s.free]
    pool, used = _one_element(pool, used, every)
    _same(used)
    used = [c for c in used if not c.reason]
    steps = _steps(pool, every, used)
    pool = _distinct(steps, pool)
    pool, doubt = _remembering(pool, every, used)
    steps = _steps(pool, every, used)
    N = len(steps.X)
    room = max(2, N // PER_UNKNOWN)
    used = _strongest(steps, used, max(1, min(MOST_CONTROLS, room // 2)))
    steps = _steps(pool, every, used)
    most = max(1, min(MOST_STATES, room - len(used)))
    driven = _driven(pool, every, used)
    keep = _coupled(steps, pool, most, _is_pose(pool), driven) if N >= FEWEST else pool[:MOST_STATES]
    _effective(_steps(keep, every, used), used)
    used = [c for c in used if not c.reason]
    _delay(keep, every, used)
    return keep, doubt


def _driven(pool: Sequence[Candidate], every: dict[str, Source], used: Sequence[Candidate]) -> Array:
    """How clearly the controls show in the next step of each candidate (n,), at the delay at which they show most."""
    found = np.zeros(len(pool))
    for lag in range(LONGEST_DELAY + 1):
        steps = _steps(pool, every, used, [lag] * len(used))
        if used and len(steps.X) >= FEWEST:
            found = np.maximum(found, steps.effect(range(len(pool))))
    return found


def _distinct(steps: _Steps, pool: list[Candidate]) -> list[Candidate]:
    """Without candidates that are functions of another one, whatever their topics: copies, other units, squares.

    Such a function leaves next to nothing of a candidate, or nothing but noise. Of two that are functions of each
    other, the one in which the controls show more stays.
    """
    if len(steps.X) < FEWEST:
        return pool
    n = len(pool)
    shows = steps.effect(range(n)) if steps.U.shape[1] else np.zeros(n)
    kept: list[int] = []
    for i in np.argsort(-shows, kind="stable").tolist():
        source = next((j for j in kept if _function(steps.X[:, j], steps.X[:, i])), None)
        if source is not None:
            pool[i].reason = f"says what {_place(pool[source], pool[i])} says already"
            continue
        for j in [j for j in kept if _function(steps.X[:, i], steps.X[:, j])]:  # x stays, its square goes
            kept.remove(j)
            pool[j].reason = f"says what {_place(pool[i], pool[j])} says already"
        kept.append(i)
    return [pool[i] for i in sorted(kept)]


def _place(candidate: Candidate, beside: Candidate) -> str:
    return candidate.path if candidate.topic == beside.topic else f"{candidate.topic} {candidate.path}"


def _function(of: Array, values: Array) -> bool:
    """Whether these values (N,) are a smooth function of others at the same instants, or one sample off, but noise."""
    for shift in (0, 1, -1):
        a, b = of[max(shift, 0) : len(of) + min(shift, 0)], values[max(-shift, 0) : len(values) - max(shift, 0)]
        if np.ptp(a) == 0 or np.ptp(b) == 0:
            return False
        a = (a - a.mean()) / a.std()
        basis = np.column_stack([np.ones_like(a), a, a**2, a**3])
        rest = b - basis @ np.linalg.lstsq(basis, b, rcond=None)[0]
        share = float(rest.std() / b.std())
        memory = float(np.corrcoef(rest[1:], rest[:-1])[0, 1]) if rest.std() > 0 else 0.0
        moves = float(np.diff(b).std() / b.std())
        if share < 0.02 or (share < 0.15 and memory < 0.3 and moves < 0.7):  # white beside what it follows
            return True
    return False


def _remembering(
    pool: list[Candidate], every: dict[str, Source], used: Sequence[Candidate]
) -> tuple[list[Candidate], str]:
    """Without candidates that are noise from sample to sample; all of them, with a sentence, where all are."""
    late = [*used] * (SHORT_DELAY + 1)
    steps = _steps(pool, every, late, [lag for lag in range(SHORT_DELAY + 1) for _ in used])
    if len(steps.X) < max(FEWEST, 2 * (len(pool) + len(late))):
        return pool, ""
    share = predicted(steps.X, steps.U, steps.X + steps.dX)
    if not (share >= NOISE).any():
        return pool, (
            "nothing here is more than noise from one sample to the next: record the machine at work before you "
            "fit a model"
        )
    for candidate, known in zip(pool, share, strict=True):
        if known < NOISE:
            candidate.reason = (
                f"noise: one sample predicts {max(0.0, known):.0%} of the variance at the next, controls included"
            )
            candidate.ready = "state"
    return [c for c in pool if not c.reason], ""


def _is_pose(pool: Sequence[Candidate]) -> bool:
    """Place and attitude of a body, all of which move together somehow."""
    return all(re.search(r"position\.[xyz]$|(roll|pitch|yaw)\(", c.path) for c in pool)


def _effective(steps: _Steps, used: Sequence[Candidate]) -> None:
    """Leave out controls that show nowhere beside the others, and those that move with another one."""
    n, m = steps.X.shape[1], steps.U.shape[1]
    if len(steps.X) < FEWEST or m < 2:
        return
    moving = np.ptp(steps.U, axis=0) > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.abs(np.corrcoef(steps.U.T)) > 0.99
    shows = np.zeros(m)
    for j in range(m):
        alone = replace(steps, X=np.hstack([steps.X, np.delete(steps.U, j, axis=1)]), U=steps.U[:, [j]])
        shows[j] = np.max(alone.effect(range(n)), initial=0.0)
    for j, candidate in enumerate(used):
        twin = next((i for i in range(j) if alike[i, j] and not used[i].reason), None)
        if not moving[j]:
            candidate.reason = "does not move while the states are there"
        elif twin is not None:
            candidate.reason, candidate.ready = f"moves with {used[twin].topic} {used[twin].path}", "control"
        elif shows[j] < FAINT and shows.max() > SHOWS:
            candidate.reason, candidate.ready = "shows in the next step of none of the states", "control"


def _prefer_rates(source: Source) -> None:
    """Of a pose and its twist the twist; of a joint's position, velocity and effort not the effort."""
    moves = {c.path for c in source.free}
    if any("twist." in p for p in moves):
        for candidate in source.free:
            if "pose." in candidate.path:
                candidate.reason = "a place in a fixed frame; its rate of change is the twist above"
    if any("angular_velocity." in p or "(orientation)" in p for p in moves):
        for candidate in source.free:
            if "linear_acceleration." in candidate.path:
                candidate.reason = "an acceleration answers within a step; add it if it has a memory of its own"
    if any(p.startswith(("position[", "velocity[")) for p in moves):
        for candidate in source.free:
            if candidate.path.startswith("effort["):
                candidate.reason = "an effort answers within a step; add it if it has a memory of its own"


def _same(pool: Sequence[Candidate]) -> None:
    """Leave out what another one says already."""
    kept: list[Candidate] = []
    for candidate in pool:
        mine = np.concatenate(candidate.values)
        for other in kept:
            theirs = np.concatenate(other.values)
            if other.topic == candidate.topic and len(mine) == len(theirs):
                both = np.isfinite(mine) & np.isfinite(theirs)
                if both.sum() > 2 and np.ptp(mine[both]) > 0 and np.ptp(theirs[both]) > 0:
                    if abs(np.corrcoef(mine[both], theirs[both])[0, 1]) > 0.9999:
                        candidate.reason = f"moves with {other.path}"
                        break
        else:
            kept.append(candidate)


def _one_element(
    pool: list[Candidate], used: list[Candidate], every: dict[str, Source]
) -> tuple[list[Candidate], list[Candidate]]:
    """Where state and command name the same joints, those of the joint whose command shows most."""
    shared = [e for e in dict.fromkeys(c.element for c in used) if e and any(s.element == e for s in pool)]
    if len(shared) < 2:
        return pool, used

    def effect(element: str) -> float:
        mine = [c for c in pool if c.element == element]
        steps = _steps(mine, every, [c for c in used if c.element == element])
        return float(np.max(steps.effect(range(len(mine))), initial=0.0)) if len(steps.X) >= FEWEST else 0.0

    best = max(shared, key=effect)
    for candidate in [*pool, *used]:
        if candidate.element != best:
            candidate.reason = f"another joint than {best}; one model per joint holds better than one for all"
    return [c for c in pool if not c.reason], [c for c in used if not c.reason]


def _strongest(steps: _Steps, used: list[Candidate], most: int) -> list[Candidate]:
    """At most so many controls, those that show most."""
    if len(used) <= most or len(steps.X) < FEWEST:
        for candidate in used[most:]:
            candidate.reason = "the recording is too short for so many controls"
        return used[:most]
    n = steps.X.shape[1]
    strength = []
    for j in range(len(used)):
        alone = replace(steps, X=np.hstack([steps.X, np.delete(steps.U, j, axis=1)]), U=steps.U[:, [j]])
        strength.append(float(np.max(alone.effect(range(n)), initial=0.0)))
    order = np.argsort(strength)[::-1][:most]
    for j, candidate in enumerate(used):
        if j not in order:
            candidate.reason = "others show more, and the recording is too short for all"
    return [c for j, c in enumerate(used) if j in order]


def _coupled(steps: _Steps, pool: list[Candidate], most: int, pose: bool, driven: Array) -> list[Candidate]:
    """States in whose next step the controls show, those that help to predict them, and those that follow them.

    Of a body's pose only those in which the controls show most: all of its numbers are coupled by geometry, and a
    place adds up what the attitude did, so that the attitude goes before where the controls show in it at all.
    """
    n = len(pool)
    order = [int(i) for i in np.argsort(-driven, kind="stable")]
    angles = [i for i in order if "(" in pool[i].path and driven[i] > FAINT] if pose else []
    among = angles or order
    least = SHOWS if not pose else max(FAINT if angles else SHOWS, 0.5 * float(driven[among].max(initial=0.0)))
    kept = [i for i in among if driven[i] > least][:most]
    if not kept:
        for candidate in pool[most:]:
            candidate.reason = "the recording is too short for so many states"
        return pool[:most]
    while len(kept) < most and not pose:
        rest = [j for j in range(n) if j not in kept]
        strength = [
            max(
                float(steps.effect(kept, of=[j], given=kept).max()),
                float(steps.effect([j], of=kept, given=[j]).max()),
            )
            for j in rest
        ]
        if not rest or max(strength) <= SHOWS:
            break
        kept.append(rest[int(np.argmax(strength))])
    for j, candidate in enumerate(pool):
        if j not in kept:
            candidate.ready = "state"
            candidate.reason = (
                "the recording is too short for more"
                if len(kept) == most
                else "a place moves with the attitude by geometry, or the controls show less in it"
                if pose
                else "the controls do not show in it, and nothing couples it to the states above"
            )
    return [pool[j] for j in sorted(kept)]


def _delay(states: Sequence[Candidate], every: dict[str, Source], used: Sequence[Candidate]) -> None:
    """Samples by which each control must be taken earlier to explain clearly more of the next step: as the fit says."""
    if not used or not states:
        return
    for _ in range(2 * len(used)):
        late = [*used] * (LONGEST_DELAY + 1)
        by = [c.delay + lag for lag in range(LONGEST_DELAY + 1) for c in used]
        steps = _steps(states, every, late, by)
        N = len(steps.X)
        if N < PER_UNKNOWN * (len(states) + len(used)):
            return
        u = steps.U.T.reshape(LONGEST_DELAY + 1, len(used), N)
        found = lags(steps.X.T / _spread(steps.X), u / _spread(u[0].T)[None], steps.dX.T, np.ones(N))
        if not found:
            return
        first = max(found, key=lambda j: found[j][1])
        used[first].delay += found[first][0]


def _spread(values: Array) -> Array:
    """Size of each column, (k, 1), to divide by."""
    return np.asarray(np.maximum(np.abs(values).max(axis=0, initial=0.0), 1e-300)[:, None])


# --- names and numbers --------------------------------------------------------------------------------------------


def _name(states: Sequence[Candidate], controls: Sequence[Candidate]) -> None:
    taken: set[str] = set()
    elements = {c.element for c in states} - {""}
    for group, suffix in ((states, "state"), (controls, "command")):
        kinds = {c.kind for c in group}
        for candidate in group:
            words = _words(candidate, len(kinds) > 1)
            name = "_".join(words)
            if name in taken or (suffix == "command" and candidate.element in elements):
                name = f"{name}_{suffix}"
            number = 2
            unique = name
            while unique in taken:
                unique, number = f"{name}_{number}", number + 1
            candidate.name = unique
            taken.add(unique)
            inner = candidate.path
            candidate.unit = next((unit for pattern, unit in _UNITS if pattern.search(inner)), "")


def _words(candidate: Candidate, several_kinds: bool) -> list[str]:
    """Words of a name: those of the path that say something, else the topic's last."""
    if candidate.element:
        words = [re.sub(r"\W+", "_", candidate.element).strip("_") or "entry"]
        return [*words, *_split(candidate.kind)] if several_kinds else words
    inner = re.sub(r"^(unwrap\()?(roll|pitch|yaw)\(.*", r"\2", candidate.path)
    inner = re.sub(r"^(unwrap|norm)\(|\)+$", "", inner)
    words = [w for w in _split(inner) if w not in _DULL]
    if not words or all(len(w) == 1 or w.isdigit() for w in words):
        words = [*_split(candidate.topic.rstrip("/").rpartition("/")[2]), *words]
    return words or ["signal"]


def _split(text: str) -> list[str]:
    return [w.lower() for w in _PARTS.findall(text)]


def _operating_point(states: Sequence[Candidate], controls: Sequence[Candidate], sources: Sequence[Source]) -> None:
    """Steady states and scales by the rule for `auto`; the range where the magnitude is small beside it."""
    every = {s.topic: s for s in sources}
    clock = min((every[c.topic] for c in states), key=lambda s: s.rate)
    group = [*states, *controls]
    limits = [_hold(every[c.topic], clock)[0] if c in controls else None for c in group]
    recordings = [
        np.column_stack(
            [_held(c, every[c.topic], number, clock, limit) for c, limit in zip(group, limits, strict=True)]
        )
        for number in range(len(clock.arrival))
    ]
    recordings = [r for r in recordings if len(r)]
    signals = [Signal(c.name, c.topic, c.path, "auto", "auto") for c in group]
    steady, scale, _ = resolve_auto(signals, recordings)
    pooled = np.concatenate(recordings)
    for j, candidate in enumerate(group):
        finite = pooled[np.isfinite(pooled[:, j]), j]
        span = float(np.ptp(finite)) if len(finite) else 0.0
        candidate.steady = steady[j] if abs(steady[j]) > 1e-3 * span else 0.0
        candidate.scale = scale[j] if scale[j] > 0.1 * span else span


def _own_scale(candidate: Candidate) -> None:
    """Median and range, for one that stands in a comment."""
    finite = np.concatenate(candidate.values)
    finite = finite[np.isfinite(finite)]
    candidate.steady, candidate.scale = float(np.median(finite)), float(np.ptp(finite))


# --- the file -----------------------------------------------------------------------------------------------------


def _text(
    bags: Sequence[Bag], sources: Sequence[Source], states: Sequence[Candidate], controls: Sequence[Candidate],
    doubt: str,
) -> str:  # fmt: skip
    every = {s.topic: s for s in sources}
    topics = list(dict.fromkeys(c.topic for c in [*states, *controls]))
    clock = min((every[c.topic] for c in states), key=lambda s: s.rate)
    lines = [
        "# Proposed by `uncertain-lti init`; read it, and edit it. From:",
        *(f"#   {bag.path.name}" for bag in bags),
        "# States are what the machine remembers from one sample to the next; controls are what is done to it, as",
        "# it is commanded. Then: uncertain-lti fit BAG... --signals THIS_FILE --output machine.model.json",
        "",
        "# The further term that measured data needs: none, disturbance, noise or both; compare the widths they give.",
        "additive: noise",
        "",
        f"# Its messages define the sample instants: {clock.rate:.4g} a second.",
        f"clock: {_quoted(clock.topic)}",
    ]
    offsets = [every[t].offset for t in topics]
    stamped = [o for o in offsets if o is not None]
    differ = any(every[t].halting for t in topics)
    differ |= len(stamped) > 0 and (
        max(stamped) - min(stamped) > 1.0 or (len(stamped) < len(offsets) and _far(stamped))
    )
    if differ:
        lines += [
            "",
            "# Their header stamps stand still, or not all go by one clock: times of arrival serve for all.",
            "topics:",
        ]
        lines += [f"  {_quoted(t)}: {{time: log}}" for t in topics]
    lines += ["", "# steady: median over the longest stretch in which everything stands still; scale: the largest such"]
    lines.append("# magnitude, or the range where that is small. Both in recorded units.")
    lines += [f"# Beware: {doubt}."] if doubt else []
    lines.append("states:")
    lines += [_entry(c) for c in states]
    lines += [_entry(c, comment=c.reason, out=True) for s in sources for c in s.candidates if c.ready == "state"]
    if controls:
        lines += ["", "controls:"]
        if any(every[c.topic].role == "guess" for c in controls):
            lines.append("  # by correlation alone: nothing is called a command here")
        if any(c.delay for c in controls):
            lines.append("  # delay: by so many samples the states follow later")
        for candidate in controls:
            lines.append(_entry(candidate, *_hold(every[candidate.topic], clock)))
        for candidate in (c for s in sources for c in s.candidates if c.ready == "control"):
            limit, _ = _hold(every[candidate.topic], clock)
            lines.append(_entry(candidate, limit, candidate.reason, out=True))
    else:
        lines += [
            "",
            "# No topic looks like a command. Without controls the envelope must cover what they do.",
            "controls: []",
        ]
    left_out = _left_out(sources, {id(c) for c in [*states, *controls]})
    if left_out:
        lines += ["", "# Not proposed, and why:", *left_out]
    return "\n".join(lines) + "\n"


def _far(offsets: Sequence[float]) -> bool:
    return max(abs(o) for o in offsets) > 1.0


def _quoted(text: str) -> str:
    """As YAML takes it: plain where it may stand so, and is not read as a number or a truth value."""
    plain = not re.fullmatch(r"(?i)(y|n|yes|no|on|off|true|false|null|nan|\\.inf)", text)
    return (
        text
        if plain and re.fullmatch(r"[A-Za-z_/][A-Za-z0-9_./-]*", text)
        else '"' + re.sub(r'(["\\])', r"\\\1", text) + '"'
    )


def _entry(candidate: Candidate, max_hold: float | None = None, comment: str = "", out: bool = False) -> str:
    """Line of a signal; `out`: in a comment, ready to be taken in."""
    parts = [f"name: {_quoted(candidate.name)}", f"topic: {_quoted(candidate.topic)}"]
    parts.append('field: "' + re.sub(r'(["\\])', r"\\\1", candidate.path) + '"')
    parts += [f"steady: {_number(candidate.steady)}", f"scale: {_number(candidate.scale)}"]
    if candidate.unit:
        parts.append(f"unit: {candidate.unit}")
    if max_hold is not None:
        parts.append(f"max_hold: {_number(max_hold)}")
    if candidate.delay:
        parts.append(f"delay: {candidate.delay}")
    return f"  {'# ' * out}- {{{', '.join(parts)}}}" + (f" # {comment}" if comment else "")


def _number(value: float) -> str:
    """Six digits, as YAML reads a number (1e-05 would be a text)."""
    text = f"{value:.6g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _hold(source: Source, clock: Source) -> tuple[float | None, str]:
    """Greatest age of a command that comes at a steady rate and ends, or pauses, before the states do."""
    steps = np.concatenate([np.diff(a) for a in source.arrival if len(a) > 1] or [np.empty(0)]) * 1e-9
    steps = steps[steps > 0]
    if not len(steps):
        return None, ""
    usual, long = float(np.median(steps)), float(np.percentile(steps, 99))
    if long > 4 * usual:
        return None, "comes now and then, and holds until the next one"
    pauses = float(steps.max()) > 10 * usual
    for mine, theirs in zip(source.arrival, clock.arrival, strict=False):
        pauses |= len(mine) > 0 and len(theirs) > 0 and (theirs[-1] - mine[-1]) * 1e-9 > 10 * usual
    if not pauses:
        return None, ""
    limit = max(5 * usual, 2 * long)
    power = 10.0 ** math.floor(math.log10(limit))
    return next(f * power for f in (1, 2, 5, 10) if f * power >= limit), "s; older ones have ended"


def _left_out(sources: Sequence[Source], chosen: set[int]) -> list[str]:
    lines = []
    for source in sources:
        groups: dict[str, list[str]] = {}
        for candidate in source.candidates:
            if id(candidate) not in chosen and not candidate.ready:
                groups.setdefault(candidate.reason or source.reason, []).append(candidate.path)
        if source.reason and (not groups or set(groups) == {source.reason}):
            lines.append(f"#   {source.topic}: {_one_line(source.reason)}")
            continue
        for reason, paths in groups.items():
            lines.append(f"#   {source.topic} {shortlist(paths, 6)}: {_one_line(reason)}")
    return lines


def _one_line(text: str) -> str:
    return " ".join(text.split())


__all__: list[Any] = ["Candidate", "Proposal", "propose"]
