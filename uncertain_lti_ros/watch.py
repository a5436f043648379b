# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A page that shows what a running monitor says, for the eye: the alarm's score, and the states that raise it.

The page is that of `plot`, and asks every second for what came since. It is served to this machine alone unless another
address is given; a request that names another host is refused, so that no other page in the browser can read it.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.base.text import plural
from uncertain_lti.cli.command import Result
from uncertain_lti.monitor.outputs import NODE
from uncertain_lti.monitor.snapshot import BACK_NS
from uncertain_lti.reports.pages import Plotted, interactive_page, packed_data, plotted_live
from uncertain_lti_ros.process import living, resolved_name, seconds
from uncertain_lti_ros.topics import stamp_ns

_EVERY = 1000  # ms between two looks of the page
_MOST = 100_000  # samples kept
_SILENT = 2.0  # s without a message from which on the page says so
_BEHIND = 200  # samples back at most to that of which a number is


class _Said:
    """The last samples of one model, rings of a row each; `statistics` are there once a message names them."""

    def __init__(self, names: list[str]) -> None:
        self.names, self.statistic_names = names, list[str]()
        self.t_ns, self.alarm = np.zeros(_MOST, dtype=np.int64), np.zeros(_MOST, dtype=bool)
        self.flags, self.utilisation = np.empty((2, _MOST, len(names)))
        self.statistics = np.empty((_MOST, 0))
        self.count = 0
        self.early = dict[int, list[tuple[NDArray[Any], JointState]]]()  # by stamp: numbers that overtook their flags

    def rows(self, window: float) -> list[NDArray[Any]]:
        """Copies of all five over the last seconds, the oldest sample first."""
        order = np.arange(max(0, self.count - _MOST), self.count) % _MOST
        t_ns = self.t_ns[order]
        shown = t_ns >= t_ns[-1:] - window * 1e9
        shown[: max(np.flatnonzero(np.diff(t_ns) < -BACK_NS), default=-1) + 1] = False  # of the pass before, in a loop
        order = order[shown]
        return [ring[order] for ring in (self.t_ns, self.alarm, self.flags, self.utilisation, self.statistics)]


class Watched:
    """What a monitor has said lately; messages come in one thread, and are read in others.

    `node`: subscribes; `name`: of the monitor; `window`: s that the page shows.
    """

    def __init__(self, node: Node, name: str, window: float) -> None:
        self.name, self._window, self._node = resolved_name(node, name, "node", "/envelope_monitor"), window, node
        self._lock = threading.Lock()
        self._said = _Said([])
        self._heard, self._reason = 0.0, ""
        many, latched = QoSProfile(depth=1000), QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, topic, take, qos in (
            (JointState, "flags", self._flags, many), (Bool, "violation", self._violation, many),
            (JointState, "utilisation", self._utilisation, many), (JointState, "statistics", self._statistics, many),
            (String, "reason", self._why, latched),
        ):  # fmt: skip
            node.create_subscription(kind, f"{self.name}/{topic}", partial(self._locked, take), qos)

    def _locked(self, take: Callable[[Any], None], message: Any) -> None:
        with self._lock:
            take(message)

    def _flags(self, message: JointState) -> None:
        if self._said.names != list(message.name):
            self._said = _Said(list(message.name))
        said, row = self._said, self._said.count % _MOST
        said.t_ns[row], said.flags[row] = stamp_ns(message), message.position
        said.alarm[row] = said.count and said.alarm[row - 1]
        said.utilisation[row] = said.statistics[row] = np.nan
        said.count += 1
        for ring, early in said.early.pop(said.t_ns[row].item(), ()):
            ring[row] = early.position
        self._heard = time.monotonic()

    def _violation(self, message: Bool) -> None:
        if self._said.count:
            self._said.alarm[(self._said.count - 1) % _MOST] = message.data

    def _utilisation(self, message: JointState) -> None:
        if self._said.names == list(message.name):
            self._put(self._said.utilisation, message)

    def _statistics(self, message: JointState) -> None:
        if self._said.statistic_names != list(message.name):
            self._said.statistic_names = list(message.name)
            self._said.statistics = np.empty((_MOST, len(message.name)))
            self._said.statistics[: self._said.count] = np.nan
        self._put(self._said.statistics, message)

    def _put(self, ring: NDArray[Any], message: JointState) -> None:
        """Numbers of a sample that was flagged lately, or will be: topics have no order among them."""
        said, t_ns = self._said, stamp_ns(message)
        for back in range(1, min(said.count, _BEHIND) + 1):
            row = (said.count - back) % _MOST
            if said.t_ns[row] == t_ns:
                ring[row] = message.position
                return
        said.early.setdefault(t_ns, []).append((ring, message))
        if len(said.early) > _BEHIND:
            said.early.pop(next(iter(said.early)))

    def _why(self, message: String) -> None:
        self._reason = message.data

    def plotted(self) -> Plotted:
        """The last `window` seconds."""
        with self._lock:
            said, heard, reason = self._said, self._heard, self._reason
            statistic_names, rows = said.statistic_names, said.rows(self._window)
        t_ns, alarm, flags, utilisation, statistics = rows
        t = np.maximum.accumulate(t_ns)  # one that is late is drawn beside the one before it
        t = (t - t[-1:]) * 1e-9
        quiet, gone = time.monotonic() - heard, ""
        silent = quiet > max(_SILENT, 3.0 * float(np.median(np.diff(t))) if len(t) > 1 else 0.0)
        if silent and not self._node.count_publishers(f"{self.name}/flags"):
            gone = f"; no such node is in ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')}"
        raised = bool(alarm[-1:].any()) and not gone and not reason.startswith("inactive")  # and nobody takes it back
        if len(t):
            said_last = f"; it said last: {reason}." if gone else f"; {reason}."
            note = f"{plural(len(t), 'sample')}, 0 s is the newest" + (said_last if reason else ".")
            note = f"Nothing has come for {quiet:.0f} s{gone}. {note}" if silent else note
        else:
            note = f"Waiting for {self.name}: nothing is heard on {self.name}/flags{gone}."
        note, state = f"{'ALARM. ' if raised else ''}{note}", ["ALARM"] * raised + ["SILENT"] * silent
        of_each = dict(zip(statistic_names, statistics.T, strict=True))
        found = plotted_live(self.name, said.names, t, flags, alarm, utilisation, of_each, note)
        return replace(found, title=" ".join([*state, self.name]))


@contextmanager
def serving(watched: Watched, host: str, port: int) -> Iterator[str]:
    """Serve the page while the block runs; the address. Raises UncertainLTIError where the port is taken."""
    local = host in ("127.0.0.1", "localhost")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
            if local and asked not in ("127.0.0.1", "localhost"):
                self.send_error(403, "this page is for this machine alone")
            elif self.path == "/":
                page = interactive_page(watched.name, [watched.plotted()], every=_EVERY)
                self._answer("text/html; charset=utf-8", page)
            elif self.path == "/data":
                self._answer("application/json", packed_data([watched.plotted()], _EVERY))
            else:
                self.send_error(404)

        def _answer(self, kind: str, text: str) -> None:
            body = text.encode("utf-8", "replace")
            self.send_response(200)
            for name, value in (
                ("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store"),
                ("X-Content-Type-Options", "nosniff"), ("X-Frame-Options", "DENY"),
            ):  # fmt: skip
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: a line a second would hide all others."""

    class Server(ThreadingHTTPServer):
        def handle_error(self, request: Any, client_address: Any) -> None:
            """As it is, but for a reader that left before its answer: a page that is closed does that."""
            if not isinstance(sys.exception(), ConnectionError):
                super().handle_error(request, client_address)

    try:
        server = Server((host, port), Handler)
    except (OSError, OverflowError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise UncertainLTIError(f"{host}:{port}: cannot be served: {why}; choose another --port or --host") from None
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.2}, daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti watch`."""
    parser.add_argument("monitor", nargs="?", default=NODE, metavar="NODE", help=f"node to watch (default {NODE})")
    parser.add_argument("--port", type=int, default=8350, metavar="N", help="port of the page (default 8350; 0: any)")
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="default 127.0.0.1, this machine alone")
    parser.add_argument("--seconds", type=seconds, default=120.0, metavar="S", help="time that it shows (default 120)")


def run(args: argparse.Namespace) -> Result:
    """Serve the page until a signal of `endings`."""
    with living(lambda: Node("uncertain_lti_watch")) as life:
        with serving(Watched(life.node, args.monitor, args.seconds), args.host, args.port) as address:
            args.say(f"watching {args.monitor} at {address}; stop with Ctrl-C")
            while life.alive:
                life.spin_once()
    return Result()
