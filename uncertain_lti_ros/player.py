# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`uncertain-lti play`: the messages of a recording, as they are, back to their topics."""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from itertools import islice
from typing import Any

import yaml
from rclpy.client import Client
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from uncertain_lti.base.errors import BagError, SignalError, UncertainLTIError
from uncertain_lti.base.text import meant, plural, shortlist
from uncertain_lti.cli.command import DONE, Result, complain
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_types import RawMessage
from uncertain_lti.signals.field_path import TypeFields
from uncertain_lti_ros.process import Life, living, resolved_name, seconds, speed
from uncertain_lti_ros.topics import CLOCK, live_fields, message_class

_DEPTH = 1000
_LOOKED_AT = 10_000  # messages in which a header stamp is looked for
_CROWD = 2000.0
"""Messages a second up to which a subscriber keeps up; faster only where the recording itself is faster."""
_SIGNALLED = 128  # exit status of a process that a signal ended: this and its number
_SETTLE = 2.5  # s without a new subscriber; on a busy machine one is found so long after another
_ACKNOWLEDGED = 10.0  # s to wait at the end until everything sent has been received
_LOCKSTEP_TIMEOUT = 10.0  # s
_ASK_AGAIN = 2.0  # s; Fast DDS loses the answer to a request that came before the server found the reader of answers
_REPEAT = 0.1  # s after which /clock, which is best effort, is sent again


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti play`."""
    parser.add_argument("bag", metavar="BAG", help="recording (MCAP file, or folder of a split one)")
    parser.add_argument("--rate", type=speed, metavar="R", help="speed, times real time (default 1)")
    parser.add_argument("--clock", action="store_true", help="publish /clock (log time) before each message")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play these only (default: all)")
    parser.add_argument(
        "--wait", type=seconds, default=10.0, metavar="S", help="wait this long for subscribers (default 10 s)"
    )
    parser.add_argument(
        "--lockstep", metavar="NODE",
        help="wait after each message until this envelope_monitor has taken it; as fast as it can, and exact also "
        "where log time is the clock (then with --clock, and the node with use_sim_time)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print what was played as JSON")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only (and with --json the data)")


def _unstamped(bag: Bag, topics: Sequence[str]) -> list[str]:
    """Topics without a header stamp, or with none but zeros as far as one looks."""
    stamped: dict[str, bool] = {}
    for raw in islice(bag.raw_messages(topics), _LOOKED_AT) if topics else ():
        topic, definition = raw.channel.topic, raw.channel.definition
        if not stamped.get(topic):
            stamped[topic] = bool(definition.reason or (definition.has_header and definition.stamp_ns(raw.data)))
    return [topic for topic in topics if not stamped.get(topic, True)]


def run(args: argparse.Namespace) -> Result:
    """Play a recording to its end, or until a signal."""
    note = args.progress.note
    if args.lockstep and args.rate is not None:
        raise UncertainLTIError("--lockstep goes as fast as the node takes messages; leave out --rate")
    bag = Bag(args.bag)
    with living(lambda: Node(f"uncertain_lti_player_{os.getpid()}")) as life:
        played = _offer(life.node, bag, args.topics, args.clock, note)
        clock = life.node.create_publisher(Clock, CLOCK, QoSProfile(depth=_DEPTH)) if args.clock else None
        note(*bag.warnings)
        if not args.clock and args.rate not in (None, 1.0) and (unstamped := _unstamped(bag, list(played))):
            note(
                f"no header stamps: {shortlist(unstamped)}; a node that uses the time of receipt sees steps "
                f"{args.rate:g} times as fast; play with --clock, and start the listeners with use_sim_time"
            )
        _wait(life, played, args.wait, note)
        messages = (m for m in bag.raw_messages(list(played)) if m.channel.counted)
        if args.progress.shown:
            messages = args.progress.iterate("playing")(messages, sum(bag.topics[topic].count for topic in played))
        heard, sent = _listeners(played), Counter[str]()

        def send(message: RawMessage) -> None:
            played[message.topic].publish(message.data)
            sent[message.topic] += 1

        began, behind, crowd = time.monotonic(), 0.0, _crowd(bag, played)
        with closing(messages):  # takes the bar away
            if args.lockstep:
                _lockstep(life, played, send, clock, args.lockstep, messages, args.wait)
            else:
                for message, late in when_due(messages, args.rate or 1.0, crowd, lambda: life.alive):
                    behind = max(behind, late)
                    if clock is not None:
                        clock.publish(_clock(message.log_time_ns))
                    send(message)
        if behind > 1.0 and life.alive:
            apart = f"to keep messages at least {1e3 / crowd:.2g} ms apart"
            note(f"fell behind the requested rate by up to {behind:.1f} s, {apart}")
        took = time.monotonic() - began
        if joined := [topic for topic, count in _listeners(played).items() if count > heard[topic]]:
            note(f"{shortlist(joined)}: a subscriber came after playing began, and lacks what was before; play again")
        if missed := _unconfirmed(life, played):
            note(f"{shortlist(missed)}: a subscriber did not confirm every message within {_ACKNOWLEDGED:g} s")
    ended = f"{bag.path}: played {plural(sent.total(), 'message')} of {plural(len(played), 'topic')} in {took:.1f} s"
    if life.signal is None:
        args.say(ended)
    else:
        none = f"{bag.path}: interrupted before a message was played"
        complain("play", f"{ended}, then interrupted" if sent.total() else none)
    data = {
        "bag": str(bag.path), "messages": sent.total(), "topics": {topic: sent[topic] for topic in played},
        "seconds": took, "unconfirmed": missed, "interrupted": life.signal is not None,
    }  # fmt: skip
    return Result(_SIGNALLED + life.signal if life.signal is not None else DONE, data)


def _offer(
    node: Node, bag: Bag, topics: list[str] | None, clock: bool, note: Callable[[str], None]
) -> dict[str, Publisher]:
    """Publishers of what can be played; reports for each other topic why it cannot."""
    asked = list(bag.topics) if topics is None else list(dict.fromkeys(topics))
    for topic in asked:
        if topic not in bag.topics:
            there = f"{meant(topic, bag.topics)}; topics there: {', '.join(bag.topics) or 'none'}"
            raise BagError(f"{bag.path}: there is no topic {topic}{there}")
    played: dict[str, Publisher] = {}
    for topic in asked:
        info = bag.topics[topic]
        try:
            if clock and topic == CLOCK:
                raise SignalError("--clock makes its own")
            if not info.readable:
                raise SignalError(info.reason)
            kind = message_class(info.type)
            _hold_layout(info.type, bag.type_fields(topic), live_fields)
        except SignalError as error:
            note(f"{topic} is not played: {error}")
            continue
        qos = QoSProfile(depth=_DEPTH, durability=_durability(bag, topic))
        played[topic] = node.create_publisher(kind, topic, qos)
    if not played:
        raise BagError(f"{bag.path}: no topic of it can be played here; the lines above say why")
    return played


def _hold_layout(type_name: str, recorded: TypeFields, installed: TypeFields) -> None:
    """Raise SignalError where recorded bytes would be read wrongly by the type that is installed."""
    alike = {"char": "uint8"}
    then, now = (
        [(n.rstrip("_"), f.kind, f.array, f.kind == "string" or alike.get(f.type_name, f.type_name)) for n, f in of]
        for of in (recorded(type_name).items(), installed(type_name).items())
    )
    if then != now:
        raise SignalError(f"{type_name} was recorded in another version than is installed; install the recorded one")
    used = [f.type_name for f in installed(type_name).values() if f.kind == "message"]
    for name in reversed(used):
        _hold_layout(name, recorded, installed)


def _durability(bag: Bag, topic: str) -> DurabilityPolicy:
    """Transient local where every publisher was, as the recorder wrote down."""
    first = next((message for message in bag.raw_messages([topic]) if message.channel.counted), None)
    with suppress(yaml.YAMLError, TypeError, LookupError):  # notes of some recorder
        offered = yaml.safe_load(first.channel.metadata.get("offered_qos_profiles") or "[]") if first else []
        if offered and all(o["durability"] in (1, "transient_local") for o in offered):
            return DurabilityPolicy.TRANSIENT_LOCAL
    return DurabilityPolicy.VOLATILE


def _crowd(bag: Bag, played: Iterable[str]) -> float:
    """Messages a second that are sent at most while catching up."""
    infos = [bag.topics[topic] for topic in played]
    times = [at for info in infos for at in (info.first, info.last) if at is not None]
    span = (max(times, default=0) - min(times, default=0)) * 1e-9
    return max(_CROWD, 1.5 * sum(info.count for info in infos) / span) if span > 1.0 else _CROWD


def _wait(life: Life, played: dict[str, Publisher], limit: float, note: Callable[[str], None]) -> None:
    """Wait until every subscription that the graph shows is connected, and no new one appears for a while."""
    changed = time.monotonic()
    counts: list[int] = []

    def settled() -> bool:
        nonlocal changed, counts
        before, counts = counts, [publisher.get_subscription_count() for publisher in played.values()]
        if counts != before:
            changed = time.monotonic()
        return any(counts) and counts == wanted() and time.monotonic() - changed >= _SETTLE

    def wanted() -> list[int]:
        return [life.node.count_subscribers(topic) for topic in played]

    if life.until(settled, limit) or not life.alive:
        return
    unmet = [topic for topic, there, found in zip(played, wanted(), counts, strict=True) if there > found]
    if not any(wanted()):
        note(f"there is no subscriber to {shortlist(list(played))} after {limit:g} s")
    elif unmet:
        note(f"{shortlist(unmet)}: a subscriber asks for more quality of service than is offered; playing nevertheless")


def _listeners(played: dict[str, Publisher]) -> dict[str, int]:
    """Subscribers that are connected, of each topic whose messages none gets later."""
    volatile = DurabilityPolicy.VOLATILE
    publishers = {topic: one for topic, one in played.items() if one.qos_profile.durability == volatile}
    return {topic: publisher.get_subscription_count() for topic, publisher in publishers.items()}


def when_due(
    messages: Iterable[RawMessage], rate: float, crowd: float, alive: Callable[[], bool]
) -> Iterator[tuple[RawMessage, float]]:
    """Hand over each message at its time, never before, until `alive` returns False.

    The first is due at once; at most `crowd` messages a second go out, also while catching up.
    """
    began = last = time.monotonic()
    first: int | None = None
    for message in messages:
        if first is None:
            first = message.log_time_ns
        due = began + (message.log_time_ns - first) * 1e-9 / rate
        at = max(due, last + 1.0 / crowd)
        while alive() and (rest := at - time.monotonic()) > 0:
            time.sleep(min(rest, 0.1))
        if not alive():
            return
        last = time.monotonic()
        yield message, last - due


def _unconfirmed(life: Life, played: dict[str, Publisher]) -> list[str]:
    """Topics with a subscriber that does not confirm all messages in time; none where a signal came first."""
    end, waiting = time.monotonic() + _ACKNOWLEDGED, list(played)
    while life.alive and waiting and time.monotonic() < end:
        some = Duration(seconds=_REPEAT)
        waiting = [topic for topic in waiting if not played[topic].wait_for_all_acked(some)]
    return waiting if life.alive else []


def _clock(t_ns: int) -> Clock:
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(t_ns, 10**9)
    return message


def _lockstep(
    life: Life, played: dict[str, Publisher], send: Callable[[RawMessage], None], clock: Publisher | None, node: str,
    messages: Iterator[RawMessage], wait: float,
) -> None:  # fmt: skip
    follower = _Follower(life, f"{resolved_name(life.node, node, 'node', '/envelope_monitor')}/status", wait)
    if clock is not None and not follower.status.get("use_sim_time", True):
        raise UncertainLTIError(f"{node}: does not follow /clock; give it -p use_sim_time:=true, or leave out --clock")
    if life.alive and not {one.topic_name for one in played.values()} & {*follower.status.get("received", ())}:
        raise UncertainLTIError(f"{node}: takes no topic that is played; is it active, with a model of these topics?")
    for sent, message in enumerate(messages, start=1):
        if clock is not None:
            follower.reach(clock, message.log_time_ns)
        if not life.alive:
            break
        topic = played[message.topic].topic_name
        before = follower.received(topic)
        send(message)
        follower.take(topic, before, sent)


class _Follower:
    """The envelope_monitor that playing waits for, seen through its status service."""

    def __init__(self, life: Life, name: str, wait: float) -> None:
        self._life, self._name = life, name
        self._client: Client = life.node.create_client(Trigger, name)
        self.status: dict[str, Any] = {}
        if not life.until(self._client.service_is_ready, wait) and life.alive:
            raise UncertainLTIError(f"{name}: no such service after {wait:g} s; start the monitor, or name it so")
        self._ask()

    def received(self, topic: str) -> int | None:
        """Messages it has received on a topic; None if it does not subscribe."""
        count: int | None = self.status.get("received", {}).get(topic)
        return count

    def reach(self, clock: Publisher, at_ns: int) -> None:
        """Publish /clock until its node time is this."""
        tick = _clock(at_ns)
        clock.publish(tick)
        began = repeated = time.monotonic()
        while self._life.alive and self._ask().get("now_ns") != at_ns:
            now = time.monotonic()
            if now - repeated > _REPEAT:
                clock.publish(tick)
                repeated = now
            self._give_up(began, f"{CLOCK} at {at_ns} ns")

    def take(self, topic: str, before: int | None, number: int) -> None:
        """Wait until it has taken one more message from a topic, if it listens."""
        began = time.monotonic()
        while before is not None and self._life.alive and (self._ask() and self.received(topic)) == before:
            self._give_up(began, f"message {number}, on {topic},")
        if before is not None and self._life.alive and self.received(topic) is None:
            raise UncertainLTIError(f"{self._name}: takes {topic} no more, since message {number}; was it deactivated?")

    def _give_up(self, began: float, what: str) -> None:
        if time.monotonic() - began > _LOCKSTEP_TIMEOUT:
            raise UncertainLTIError(
                f"{self._name}: {what} was not taken within {_LOCKSTEP_TIMEOUT:g} s; is the monitor active, and does "
                f"nobody else publish on its topics?"
            )

    def _ask(self) -> dict[str, Any]:
        """The status from now on; asked for again where no answer comes, which changes nothing."""
        began, asked = time.monotonic(), -math.inf
        self.status = {}
        futures: list[Future] = []
        while self._life.alive and not any(future.done() for future in futures):
            if time.monotonic() - asked >= _ASK_AGAIN:
                asked = time.monotonic()
                futures.append(self._client.call_async(Trigger.Request()))
            self._life.spin_once()
            self._give_up(began, "a request for its status")
        for future in futures:
            if future.done():
                self.status = json.loads(future.result().message)
            self._client.remove_pending_request(future)
        return self.status
