"""SignalMap: which topic and field is which state or control."""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple

from uncertain_lti.base.english import meant, plural
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.files import kind_of

LONGEST_DELAY = 1_000_000
"""Samples by which a control may be delayed at most."""

Number = float | Literal["auto"]
TimeSource = Literal["header", "log"]


# --- message types, described the same way offline (bag definitions) and live (rclpy classes) ---------------


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one message field.

    Parameters
    ----------
    kind : {"number", "bool", "string", "message", "other"}
        What one element is.
    type_name : str
        Type of one element, as the message definition writes it.
    array : int or None, optional
        None for a single value, 0 for a sequence of any length, n for n elements.
    """

    kind: Literal["number", "bool", "string", "message", "other"]
    type_name: str
    array: int | None = None


TypeFields = Callable[[str], Mapping[str, FieldType]]
"""Type name -> {field name: FieldType}; raises SignalError for an unknown type."""


def numeric_paths(type_name: str, type_fields: TypeFields, depth: int = 6) -> Iterator[str]:
    """Field paths of a type that can be signals; arrays end in `[]` (sequence) or `[n]` (fixed length).

    Parameters
    ----------
    type_name : str
        Type of the message, as package/msg/Name.
    type_fields : callable
        Type name -> {field name: FieldType}.
    depth : int, default 6
        Levels of nested messages that are opened.

    Yields
    ------
    str
        A path that leads to numbers or booleans.
    """
    for name, kind in type_fields(type_name).items():
        suffix = "" if kind.array is None else "[]" if kind.array == 0 else f"[{kind.array}]"
        if kind.kind in ("number", "bool"):
            yield name + suffix
        elif kind.kind == "message" and depth > 1:
            for inner in numeric_paths(kind.type_name, type_fields, depth - 1):
                yield f"{name}{suffix}.{inner}"


# --- field paths --------------------------------------------------------------------------------------------

_FUNCTIONS = ("roll", "pitch", "yaw", "norm", "unwrap")
_STEP = re.compile(
    r"""\.?([A-Za-z_]\w*)|\[\s*(\d{1,18})\s*\]|\[\s*"([^"]+)"\s*\]|\[\s*([^\[\]"\s](?:[^\[\]"]*[^\[\]"\s])?)\s*\]"""
)
_NAN = math.nan


class Derived(NamedTuple):
    """A number worked out from the parts of a value, in two steps so that many messages share the first.

    Parameters
    ----------
    terms : callable
        Takes the parts (x, y, z, w of a quaternion; floats, or arrays of them: the arithmetic is the same to the last
        bit) to the arguments of `number`, and to what has to be positive for there to be one.
    number : callable
        Takes these arguments, floats alone, to the number: numpy's functions round otherwise than those of math.
    """

    terms: Callable[..., tuple[tuple[Any, ...], Any]]
    number: Callable[..., float]

    def of(self, value: Any) -> float:
        """The number for one value of a message; NaN where there is none.

        Parameters
        ----------
        value : object
            A quaternion, a vector or an array in a decoded message.

        Returns
        -------
        float
            Angle in rad, or norm; NaN where there is none.
        """
        if self is not NORM:
            return self.of_parts(value.x, value.y, value.z, value.w)
        if hasattr(value, "x"):
            return math.hypot(*(float(getattr(value, c)) for c in "xyzw" if hasattr(value, c)))
        return math.hypot(*(float(v) for v in value))

    def of_parts(self, *parts: Any) -> float:
        """The same from the parts of the value.

        Parameters
        ----------
        *parts : float
            x, y, z, w of a quaternion, or the elements of a vector.

        Returns
        -------
        float
            Angle in rad, or norm; NaN where there is none.
        """
        arguments, size = self.terms(*parts)
        return self.number(*arguments) if size > 0.0 else _NAN


def _roll(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * x + y * z), norm2 - 2.0 * (x * x + y * y)), _finite(norm2)


def _pitch(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * y - z * x), norm2), _finite(norm2)


def _yaw(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * z + x * y), norm2 - 2.0 * (y * y + z * z)), _finite(norm2)


def _finite(norm2: Any) -> Any:
    """What it is, or NaN where it is infinite: atan2 and asin would make an angle of that."""
    return norm2 * (norm2 < math.inf)


def _arc_sine(sine: float, norm2: float) -> float:
    return math.asin(max(-1.0, min(1.0, sine / norm2)))


def _themselves(*parts: Any) -> tuple[tuple[Any, ...], Any]:
    return parts, 1.0


NORM = Derived(_themselves, math.hypot)
_DERIVED: Mapping[str, Derived] = {
    "roll": Derived(_roll, math.atan2),
    "pitch": Derived(_pitch, _arc_sine),
    "yaw": Derived(_yaw, math.atan2),
    "norm": NORM,
}


class FieldPath:
    """One scalar of a message: `a.b[3]`, `position[fan]`, `yaw(pose.orientation)`, `unwrap(...)`.

    Dotted attributes; `[3]` is an index, `[fan]` the position of `fan` in the `name` array of the message that
    holds the array (as in sensor_msgs/JointState), `["3"]` a name that looks like an index. Derived: roll,
    pitch, yaw of a quaternion (any norm but 0), norm of a vector, a quaternion or an array, unwrap of an angle
    in rad (the sampler does the unwrapping, as it knows where a stream starts anew).

    Parameters
    ----------
    text : str
        The path as a signals file writes it.

    Raises
    ------
    SignalError
        The text is not a field path.
    """

    __slots__ = ("text", "unwrap", "derived", "steps", "_name_index")

    def __init__(self, text: str) -> None:
        self.text = text
        self.unwrap = False
        self.derived: Derived | None = None
        self._name_index = 0
        inner = text.strip()
        functions: list[str] = []
        while match := re.fullmatch(r"([A-Za-z_]\w*)\s*\((.*)\)", inner, re.DOTALL):
            if match[1] not in _FUNCTIONS:
                raise SignalError(
                    f"field '{text}': there is no function '{match[1]}'{meant(match[1], _FUNCTIONS)}; "
                    f"there are {', '.join(_FUNCTIONS)}"
                )
            functions.append(match[1])
            inner = match[2].strip()
        if functions[:1] == ["unwrap"]:
            self.unwrap = True
            functions = functions[1:]
        if len(functions) > 1 or "unwrap" in functions:
            raise SignalError(f"field '{text}': functions nest only as unwrap(roll|pitch|yaw(...))")
        if functions:
            self.derived = _DERIVED[functions[0]]
        self.steps = self._parse(inner)

    def _parse(self, inner: str) -> tuple[tuple[str, str | int], ...]:
        steps: list[tuple[str, str | int]] = []
        position = 0
        while position < len(inner):
            match = _STEP.match(inner, position)
            dotted = inner[position] == "."
            if not match or (match[1] is not None and dotted != bool(steps)) or (match[1] is None and not steps):
                raise SignalError(
                    f"field '{self.text}' is not a field path; write for example twist.linear.x, data[0], "
                    f"position[fan] or yaw(pose.orientation)"
                )
            if match[1] is not None:
                steps.append(("attribute", match[1]))
            elif match[2] is not None:
                steps.append(("index", int(match[2])))
            else:
                steps.append(("name", match[3] or match[4]))
            position = match.end()
        if not steps:
            raise SignalError(f"field '{self.text}' is empty; name a field of the message")
        return tuple(steps)

    def __repr__(self) -> str:
        return f"FieldPath({self.text!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FieldPath) and other.text == self.text

    def __hash__(self) -> int:
        return hash(self.text)

    def read(self, message: Any) -> float:
        """Value in this message; NaN where an index or a name is not there, or a quaternion is all zero.

        Parameters
        ----------
        message : object
            A decoded message of the type that the path was checked against.

        Returns
        -------
        float
            The number as recorded, in rad for a derived angle; not unwrapped.
        """
        value, parent = message, message
        for kind, key in self.steps:
            if kind == "attribute":
                parent, value = value, getattr(value, key)  # type: ignore[arg-type]
            elif kind == "index":
                if key >= len(value):  # type: ignore[operator]
                    return _NAN
                value = value[key]
            else:
                index = self._find_name(parent.name, key)  # type: ignore[arg-type]
                if index < 0 or index >= len(value):
                    return _NAN
                value = value[index]
        return self.derived.of(value) if self.derived else float(value)

    def _find_name(self, names: Sequence[str], wanted: str) -> int:
        index = self._name_index  # names seldom move between messages
        if index < len(names) and names[index] == wanted:
            return index
        for index, name in enumerate(names):
            if name == wanted:
                self._name_index = index
                return index
        return -1

    def absent(self, message: Any) -> str:
        """What this path looks up and the message has not, in words, with what is there; empty where it has.

        Parameters
        ----------
        message : object
            A decoded message of the type that the path was checked against.

        Returns
        -------
        str
            A sentence, or an empty text where the message has the value.
        """
        value, parent, name = message, message, ""
        for kind, key in self.steps:
            if kind == "attribute":
                parent, value, name = value, getattr(value, key), str(key)  # type: ignore[arg-type]
                continue
            names = [str(one) for one in parent.name] if kind == "name" else []
            if kind == "name" and key not in names:
                there = ", ".join(names) or "none"
                return f"there is no '{key}' in the message's names{meant(key, names)}; names there: {there}"
            index = names.index(str(key)) if kind == "name" else int(key)
            if index >= len(value):
                if not len(value):
                    return f"'{name}' has no element in the message; choose a field that is filled"
                there = f"elements there: 0 to {len(value) - 1}"
                return f"'{name}' has {plural(len(value), 'element')} in the message; {there}"
            value = value[index]
        return ""

    def check(self, topic: str, type_name: str, type_fields: TypeFields) -> None:
        """Check the path against a message type.

        Parameters
        ----------
        topic : str
            Topic that carries the type, for the error.
        type_name : str
            Type of the message, as package/msg/Name.
        type_fields : callable
            Type name -> {field name: FieldType}.

        Raises
        ------
        SignalError
            The path is not in the type, or is not one number; the sentence names what is there.
        """
        here = f"field '{self.text}' of {topic} ({type_name})"
        current: FieldType = FieldType("message", type_name)
        parent: Mapping[str, FieldType] = {}
        for kind, key in self.steps:
            if kind == "attribute":
                if current.array is not None:
                    raise SignalError(f"{here}: give an index before '.{key}', for example [0]")
                if current.kind != "message":
                    raise SignalError(f"{here}: a {current.type_name} has no fields, so no '{key}'")
                parent = type_fields(current.type_name)
                if key not in parent:
                    raise SignalError(
                        f"{here}: there is no '{key}' in {current.type_name}{meant(key, parent)}; fields there: "
                        f"{', '.join(parent) or 'none'}; numeric field paths of {topic}: "
                        f"{_some(numeric_paths(type_name, type_fields))}"
                    )
                current = parent[str(key)]
                continue
            if current.array is None:
                raise SignalError(f"{here}: '[{key}]' follows something that is not an array; leave it out")
            if kind == "index" and current.array and int(key) >= current.array:
                raise SignalError(f"{here}: index {key} is past the end of an array of {current.array}")
            if kind == "name":
                names = parent.get("name")
                if names is None or names.kind != "string" or names.array is None:
                    raise SignalError(
                        f"{here}: '[{key}]' needs an array of strings called 'name' beside it; "
                        f"give an index instead, for example [0]"
                    )
            current = replace(current, array=None)
        self._check_leaf(here, current, type_name, topic, type_fields)

    def _check_leaf(self, here: str, leaf: FieldType, type_name: str, topic: str, type_fields: TypeFields) -> None:
        if self.derived is not None:
            number = leaf.kind == "number"
            inner = type_fields(leaf.type_name) if leaf.kind == "message" and leaf.array is None else {}
            if self.derived is NORM:
                fits = (number and leaf.array is not None) or ("x" in inner and inner["x"].kind == "number")
                wants = "a vector with x, y, z or an array of numbers"
            else:
                fits = all(c in inner and inner[c].kind == "number" for c in "xyzw")
                wants = "a quaternion with x, y, z, w"
            if not fits:
                raise SignalError(f"{here}: wants {wants}, and {leaf.type_name} is none")
        elif leaf.kind not in ("number", "bool") or leaf.array is not None:
            what = "an array; give an index, for example [0]" if leaf.array is not None else f"a {leaf.type_name}"
            raise SignalError(
                f"{here} is not one number but {what}; numeric field paths of {topic}: "
                f"{_some(numeric_paths(type_name, type_fields))}"
            )


def _some(paths: Iterator[str], limit: int = 24) -> str:
    found = list(paths)
    more = f", and {len(found) - limit} more" if len(found) > limit else ""
    return (", ".join(found[:limit]) or "none") + more


# --- the map ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Signal:
    """One state or control: where it is read, and the operating point it is measured from.

    Parameters
    ----------
    name : str
        Name of the signal; each in a map has its own.
    topic : str
        Topic that carries it.
    field : str
        Path of the number in the message, as `FieldPath` reads it.
    steady : float or "auto", default 0.0
        Steady state in recorded units; `auto` asks for the rule in `operating_point`.
    scale : float or "auto", default 1.0
        Positive scale in recorded units; `auto` likewise.
    unit : str, default ""
        Unit as it is shown.
    type : str, default ""
        Message type of the topic; empty while it is unknown.
    max_hold : float or None, optional
        Greatest age, s, at which a held control still counts; None for no limit. For controls only.
    delay : int, default 0
        Samples by which a control is shifted: sample k takes u(t_{k - delay}). For controls only.
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


class UncarriedTopicError(SignalError):
    """A signals file names a topic that carries no signal.

    Parameters
    ----------
    text : str
        The sentence for a person.
    topics : tuple of str
        The topics that do carry a signal, any of which may be misspelt.
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
        States, in the order of x; at least one.
    controls : tuple of Signal, optional
        Controls, in the order of u.
    clock : str or None, optional
        Topic whose messages define the sample instants; None for the slowest state topic.
    max_gap : float or None, optional
        Longest step that is still a transition, s; None for 2.5 x the median step.
    min_step : float, default 0.0
        Shortest step, s; a message sooner than that is dropped.
    max_skew : float or None, optional
        Greatest age of a state from another topic than the clock, s; None for `max_gap`.
    time : mapping of str to {"header", "log"}, optional
        Per topic whether its instant is the header stamp or the log time; for a topic that is left out, header where
        most of its messages carry a stamp.
    additive : {"none", "disturbance", "noise", "both"} or None, optional
        The additive term of a fit that is given none.
    structure : object, optional
        The rules on single elements that a fit keeps (`identification.structure`); None for no rule.
    source : str, default "signals"
        What errors call the map: the path of its file.

    Raises
    ------
    SignalError
        A name is used twice, a number is out of range, a field is not a field path, or nothing is a state.
    """

    states: tuple[Signal, ...]
    controls: tuple[Signal, ...] = ()
    clock: str | None = None
    max_gap: float | None = None
    min_step: float = 0.0
    max_skew: float | None = None
    time: Mapping[str, TimeSource] = field(default_factory=dict)
    additive: Literal["none", "disturbance", "noise", "both"] | None = None
    structure: Any = None
    source: str = "signals"

    def __post_init__(self) -> None:
        if not self.states:
            raise SignalError(f"{self.source}: 'states' is empty; list at least one state")
        seen: set[str] = set()
        for signal in (*self.states, *self.controls):
            where = f"{self.source}: signal '{signal.name}'"
            if signal.name in seen:
                raise SignalError(f"{where} is listed twice; give each state and control its own name")
            seen.add(signal.name)
            try:
                FieldPath(signal.field)
            except SignalError as error:
                raise SignalError(f"{where}: {error}") from None
            if signal.scale != "auto" and not (math.isfinite(signal.scale) and signal.scale > 0):
                raise SignalError(f"{where}: scale is {signal.scale}; it must be a positive number or auto")
            if signal.steady != "auto" and not math.isfinite(signal.steady):
                raise SignalError(f"{where}: steady is {signal.steady}; it must be a finite number or auto")
            if signal.max_hold is not None and not 0 <= signal.max_hold < math.inf:
                raise SignalError(
                    f"{where}: max_hold is {signal.max_hold}; it must be 0 s or more, or left out for no limit"
                )
            if not 0 <= signal.delay <= LONGEST_DELAY:
                raise SignalError(
                    f"{where}: delay is {reprlib.repr(signal.delay)}; it must be 0 to {LONGEST_DELAY} samples"
                )
        for signal in self.states:
            if signal.max_hold is not None or signal.delay:
                raise SignalError(
                    f"{self.source}: state '{signal.name}' has max_hold or delay; both are for controls "
                    f"(the age of a state is limited by max_skew)"
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
        for name in ("max_gap", "max_skew"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise SignalError(f"{self.source}: {name} is {value}; it must be a positive number of seconds")
        if not (math.isfinite(self.min_step) and self.min_step >= 0):
            raise SignalError(f"{self.source}: min_step is {self.min_step}; it must be 0 s or more")

    def __len__(self) -> int:
        return len(self.states) + len(self.controls)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self.signals)

    def __getitem__(self, position: int) -> Signal:
        """Signal at a position of [x; u]."""
        return self.signals[position]

    @property
    def signals(self) -> tuple[Signal, ...]:
        """States, then controls, in the order of z = [x; u]."""
        return self.states + self.controls

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
        return replace(
            self,
            states=tuple(replace(s, type=types.get(s.topic, s.type)) for s in self.states),
            controls=tuple(replace(s, type=types.get(s.topic, s.type)) for s in self.controls),
        )

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
        import yaml  # the live node reads signals from the model file and needs no YAML

        if (kind := kind_of(path)) and kind != "a signals file":
            raise SignalError(f"{path}: this is {kind}, and a signals file is wanted here; {_other(kind)}")
        try:
            with open(path, encoding="utf-8") as stream:
                node = yaml.compose(stream, Loader=yaml.SafeLoader)
            if repeated := _repeated_key(node):
                raise SignalError(
                    f"{path}: key '{repeated.value}' stands twice in one mapping, again at line "
                    f"{repeated.start_mark.line + 1}; keep one"
                )
            data = yaml.SafeLoader("").construct_document(node) if node else None
        except FileNotFoundError:
            raise SignalError(f"{path}: there is no such signals file; check the path") from None
        except OSError as error:
            raise SignalError(f"{path}: cannot be read: {error.strerror}; check the path") from None
        except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: not UTF-8, or a date 2001-99-99
            mark = getattr(error, "problem_mark", None)
            line = f" at line {mark.line + 1}" if mark else ""
            problem = str(getattr(error, "problem", None) or error).splitlines()[0]
            raise SignalError(f"{path}: is not YAML{line}: {problem}; mend it") from None
        if data is None:
            raise SignalError(
                f"{path}: nothing is in it; list the states and controls, or let `uncertain-lti init` propose them"
            )
        return cls.from_dict(data, source=os.fspath(path))

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
        top = _keys(
            data,
            source,
            {"clock", "max_gap", "min_step", "max_skew", "additive", "structure", "topics", "states", "controls"},
        )
        time: dict[str, TimeSource] = {}
        for topic, options in _keys(top.get("topics") or {}, f"{source}: topics", None).items():
            said = _keys(options, f"{source}: topics: {topic}", {"time"}).get("time")
            if said not in ("header", "log"):
                raise SignalError(f"{source}: topics: {topic}: time is {reprlib.repr(said)}; write header or log")
            time[topic] = said
        additive = top.get("additive")
        if additive not in (None, "none", "disturbance", "noise", "both"):
            raise SignalError(f"{source}: additive is {reprlib.repr(additive)}; write none, disturbance, noise or both")
        clock = top.get("clock")
        if clock is not None and not isinstance(clock, str):
            raise SignalError(f"{source}: clock is {reprlib.repr(clock)}; write the name of a state topic")
        return cls(
            states=_signals(top.get("states"), f"{source}: states", need_topics),
            controls=_signals(top.get("controls"), f"{source}: controls", need_topics),
            clock=clock,
            max_gap=_number(top.get("max_gap"), f"{source}: max_gap"),
            min_step=_number(top.get("min_step"), f"{source}: min_step") or 0.0,
            max_skew=_number(top.get("max_skew"), f"{source}: max_skew"),
            time=time,
            additive=additive,
            structure=top.get("structure"),
            source=source,
        )


def _repeated_key(top: Any) -> Any:
    """The first key node that stands twice in its mapping, of which YAML readers keep the last; None without any."""
    waiting, seen = [top], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen or not isinstance(getattr(node, "value", None), list):
            continue  # an alias, or a scalar
        seen.add(id(node))
        keys = set()
        for entry in node.value:
            if not isinstance(entry, tuple):
                waiting.append(entry)
                continue
            key, value = entry
            waiting += [key, value]
            if isinstance(key.value, str):
                if key.value in keys:
                    return key
                keys.add(key.value)
    return None


def _keys(data: Any, where: str, known: set[str] | None) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise SignalError(f"{where}: a mapping is wanted here, not {_kind(data)}; see config/signals/")
    for key in data:
        if known is not None and key not in known:
            raise SignalError(
                f"{where}: unknown key {reprlib.repr(key)}{meant(key, known)}; known are {', '.join(sorted(known))}"
            )
    return data


def _kind(data: object) -> str:
    """What something is in the words of YAML."""
    names = {dict: "a mapping", list: "a list", str: "a text", bool: "a truth value", type(None): "nothing"}
    return names.get(type(data), "a number" if isinstance(data, (int, float)) else type(data).__name__)


def _other(kind: str) -> str:
    """What to do about a file of another kind."""
    return "name a file in it" if kind == "a folder" else "are the arguments swapped?"


def _number(value: Any, where: str) -> float | None:
    if value is None:
        return None
    if isinstance(value, str):  # YAML 1.1 reads 1e-3 as text
        try:
            value = float(value)
        except ValueError:
            pass
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:
        number = math.nan
    if math.isnan(number):
        raise SignalError(f"{where} is {reprlib.repr(value)}; write a number")
    return number


def _signals(data: Any, where: str, need_topics: bool) -> tuple[Signal, ...]:
    if data is None:
        return ()
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {_kind(data)}; see config/signals/")
    known = {f.name for f in fields(Signal)}
    signals = []
    for position, entry in enumerate(data):
        here = f"{where}[{position}]"
        entry = dict(_keys(entry, here, known))
        for key in ("name", "topic", "field"):
            if not isinstance(entry.get(key), str) or not (entry[key] or (key == "topic" and not need_topics)):
                if entry.get(key) is None:
                    raise SignalError(f"{here}: '{key}' is missing; every signal has a name, a topic and a field")
                raise SignalError(f"{here}: '{key}' is {reprlib.repr(entry.get(key))}; write a text, in quotes")
        for key in ("steady", "scale"):
            if key in entry and entry[key] != "auto":
                number = _number(entry[key], f"{here}: {key}")
                entry[key] = number if number is not None else {"steady": 0.0, "scale": 1.0}[key]
        if "max_hold" in entry:
            entry["max_hold"] = _number(entry["max_hold"], f"{here}: max_hold")
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
