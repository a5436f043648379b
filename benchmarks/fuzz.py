# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Damaged recordings and messages, seeded: each must give a clear error or a correct reading, soon and in bounds.

    ./run python benchmarks/fuzz.py                            # 10 000 of each kind
    ./run python benchmarks/fuzz.py --kinds structures --count 2000
    ./run python benchmarks/fuzz.py --count 1 --seed 4711      # one case again

A case fails when anything but an error meant for a person comes out of it, when it takes over 10 s of processor time or
hangs, when it asks for over 1 GiB of memory, or when its reading is wrong. A reading is wrong when the readers
disagree (by message and by arrays, or layout and middleware), when a chunk whose checksum holds gives a message that
was never written, or when an annotated copy holds other messages than were read, or another library cannot walk it.
Files are damaged after they are written; structures are made to hurt (`tests/hostile_writer.py`): lengths that reach
over their neighbours, the smallest records repeated, chunks in chunks, schemas without end, an index that lies.
Streams are whole, and in disorder (`tests/perturbed.py`): the verdicts of a live session, with schedule, horizons,
statistics, memories and frozen states, have to be those of a check, to the bit, also after a swap of the model and if
messages are held up. Cases
run in processes of their own, in batches, so that what kills a process or hangs in C is noticed as well.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
if not any("uncertain_lti" in str(p) for p in sys.path):
    sys.path.insert(0, str(ROOT / "tests" / "checkout"))

from bag_writer import Layout, Message, Topic, cdr, float64, header, message, places, write  # noqa: E402
from by_message import read_stream_by_message  # noqa: E402
from hostile_writer import hostile_file  # noqa: E402
from perturbed import CASES, difference  # noqa: E402

LIMIT_CPU_S = 10.0  # of processor time: a hang, also on a processor half as fast
LIMIT_S = 600.0  # of time: only what waits for ever takes so long, however busy the machine is
LIMIT_MEMORY = 1 << 30
BATCH = 250
JOINT_STATE, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
STATE, POSE, COMMAND = "/state", "/pose", "/command"
LAYOUTS = (
    Layout("zstd"),
    Layout("lz4"),
    Layout("none"),
    Layout("none", chunked=False),
    Layout("zstd", summary=False, indexes=False),
    Layout("lz4", chunk_size=1 << 16, indexes=False),
    Layout("zstd", chunk_size=1 << 16),
    Layout("none", checksums=False),
)
SIGNALS = f"""
clock: {STATE}
max_gap: 1.0
states:
  - {{name: a, topic: {STATE}, field: "position[a]", steady: 0, scale: 1}}
  - {{name: b, topic: {STATE}, field: "velocity[1]", steady: 0, scale: 1}}
  - {{name: yaw, topic: {POSE}, field: "yaw(pose.pose.orientation)", steady: 0, scale: 1}}
controls:
  - {{name: c, topic: {COMMAND}, field: data, steady: 0, scale: 1}}
"""


class WrongError(Exception):
    """What was read is not what is there."""


# --- what is damaged ----------------------------------------------------------------------------------------


def joint_state(t_ns: int, k: int) -> bytes:
    return cdr(
        JOINT_STATE, header=header(t_ns, "base"), name=["a", "b", "longer name"], position=np.array([k, 1.0, 2.0]),
        velocity=np.array([0.5, k, 1.5]), effort=np.empty(0),
    )  # fmt: skip


def odometry(t_ns: int, k: int) -> bytes:
    vector = {name: message("geometry_msgs/msg/Vector3", x=0.1 * k, y=0.0, z=0.0) for name in ("linear", "angular")}
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(0.01 * k), w=np.cos(0.01 * k)),
    )
    return cdr(
        ODOMETRY, header=header(t_ns, "odom"), child_frame_id="base",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=message(
            "geometry_msgs/msg/TwistWithCovariance", twist=message("geometry_msgs/msg/Twist", **vector),
            covariance=np.zeros(36),
        ),
    )  # fmt: skip


@cache
def messages_of_a_run() -> tuple[Message, ...]:
    found, t = [], 1_700_000_000_000_000_000
    for k in range(40):
        found += [
            Message(COMMAND, t, float64(0.1 * k)),
            Message(POSE, t + 1_000_000, odometry(t, k)),
            Message(STATE, t + 2_000_000, joint_state(t, k)),
        ]
        t += 20_000_000
    return tuple(found)


TOPICS = (Topic(STATE, JOINT_STATE), Topic(POSE, ODOMETRY), Topic(COMMAND))


@cache
def whole(layout: Layout) -> bytes:
    return write(TOPICS, messages_of_a_run(), layout).data


LIES = tuple(
    value.to_bytes(size, "little")
    for size, values in (
        (4, (0, 1, 3, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**30)),
        (8, (0, 1, 2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1)),
    )
    for value in values
)


def damaged(rng: random.Random, data: bytes, first: int = 0, aligned: int = 1) -> bytes:
    """A few bytes changed, lengths made to lie, stretches cut out, repeated, moved or zeroed, or the end cut off."""
    body = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if len(body) <= first + 8:
            break
        at = rng.randrange(first, len(body)) // aligned * aligned
        kind = rng.random()
        if kind < 0.25:
            body[at] = rng.randrange(256)
        elif kind < 0.55:
            lie = rng.choice(LIES)
            body[at : at + len(lie)] = lie
        elif kind < 0.65:
            del body[at:]
        elif kind < 0.75:
            del body[at : at + rng.randrange(1, 200)]
        elif kind < 0.85:
            body[at:at] = body[at : at + rng.randrange(1, 200)]
        elif kind < 0.93:
            to = rng.randrange(first, len(body))
            part = body[at : at + rng.randrange(1, 100)]
            body[to : to + len(part)] = part
        else:
            body[at : at + 50] = bytes(len(body[at : at + 50]))
    return bytes(body)


def damaged_file(rng: random.Random) -> tuple[bytes, bool]:
    """A file, and whether every message in it that has a checksum which holds was written like that."""
    layout = rng.choice(LAYOUTS)
    kind = rng.random()
    if kind < 0.35:  # the messages themselves; the file around them is whole
        changed = []
        for m in messages_of_a_run():
            body = damaged(rng, m.data, first=rng.choice((0, 4))) if rng.random() < 0.2 else m.data
            changed.append(Message(m.topic, m.log_time, body))
        return write(TOPICS, changed, layout).data, False
    data = whole(layout)
    checked = layout.checksums and layout.chunked
    if kind < 0.7:
        return damaged(rng, data), checked
    body = bytearray(data)  # the head of some record: its opcode, length, and the numbers after them
    record = rng.choice(places(data))
    for _ in range(rng.choice((1, 1, 2))):
        lie = rng.choice(LIES)
        at = record.begin + rng.choice((0, 1, 1, 9, 17, 25, 29, 33, 37, 41))
        if at + len(lie) < len(body):
            body[at : at + len(lie)] = lie
    return bytes(body), checked


# --- one case -----------------------------------------------------------------------------------------------


def read_file(rng: random.Random, folder: Path) -> str:
    """Every way in which a recording is read; returns what became of it."""
    path = folder / "damaged.mcap"
    data, checked = damaged_file(rng)
    path.write_bytes(data)
    return read_every_way(path, checked)


def read_structure(rng: random.Random, folder: Path) -> str:
    """Every way in which a recording is read, and its annotated copy."""
    path = folder / "hostile.mcap"
    path.write_bytes(hostile_file(rng, TOPICS, messages_of_a_run()))
    outcome = read_every_way(path, False)
    if outcome == "read":
        compare_with_copy(path)
    return outcome


def compare_with_copy(path: Path) -> None:
    """Annotate a recording; what was read of it has to be in the copy, and the mcap library has to walk that."""
    from mcap.stream_reader import StreamReader

    from uncertain_lti import SignalMap, UncertainLTI
    from uncertain_lti.base.errors import UncertainLTIError
    from uncertain_lti.recordings.bag import Bag
    from uncertain_lti.sampling.reading import read_transients

    model, copy = path.parent / "m.model.json", path.parent / "copy.mcap"
    copy.unlink(missing_ok=True)
    try:
        (run,) = read_transients([path], SignalMap.load(path.parent / "signals.yaml"))
    except UncertainLTIError:
        return
    UncertainLTI(np.zeros((3, 3)), np.zeros((3, 1)), np.eye(3), np.ones((3, 1)), signals=run.signals).save(model)
    status, text = command(["check", str(model), str(path), "--write", str(copy)])
    if status not in (0, 1, 2, 3) or "Traceback" in text:
        raise WrongError(f"check ended with {status}: {text[-500:]}")
    if not copy.exists():
        return
    bag, copied = Bag(path), Bag(copy)
    one, other = ([(m.topic, m.log_time_ns, m.data) for m in b.raw_messages(bag.topics)] for b in (bag, copied))
    if sorted(one) != sorted(other):
        raise WrongError(f"{len(one)} messages were read, and the copy has {len(other)}, or others")
    with open(copy, "rb") as stream:
        number = sum(type(r).__name__ == "Message" for r in StreamReader(stream, validate_crcs=True).records)
    if number != sum(part.count for part in copied._contents):
        raise WrongError("the mcap library finds another number of messages in the copy")


def command(arguments: list[str]) -> tuple[int, str]:
    """Exit status and output of a command."""
    from uncertain_lti.cli.main import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = main(arguments)
    text = said.getvalue()
    if odd := [c for c in text if not c.isprintable() and c != "\n"]:
        raise WrongError(f"{arguments[0]} prints {odd[0]!r}")
    return status, text


def read_every_way(path: Path, checked: bool) -> str:
    """Read one file; checked: every message in it that has a checksum which holds was written like that."""
    from uncertain_lti import SignalMap
    from uncertain_lti.base.errors import UncertainLTIError
    from uncertain_lti.recordings.bag import Bag
    from uncertain_lti.sampling.reading import read_stream

    folder = path.parent
    signals = SignalMap.load(folder / "signals.yaml")
    outcome = "read"
    status, text = command(["topics", str(path)])
    if status not in (0, 2) or "Traceback" in text:
        raise WrongError(f"topics ended with {status}: {text[-500:]}")
    try:
        bag = Bag(path)
        bag.facts()
        written = {(m.log_time, m.data) for m in messages_of_a_run()}
        checked &= not any("cut after" in warning for warning in bag.warnings)  # nothing vouches for the last chunk
        if checked and any((m.log_time_ns, m.data) not in written for m in bag.raw_messages()):
            raise WrongError("a message that was never written")
    except UncertainLTIError:
        outcome = "refused"
    readings: list[Any] = []
    for read in (read_stream, read_stream_by_message):
        try:
            stream = read(Bag(path, indexed=read is read_stream), signals)
            readings.append([stream.topic, stream.arrival, stream.stamp, *stream.values])
        except UncertainLTIError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                raise WrongError(f"no sentence: {error}") from None
            readings.append(None)
    if (readings[0] is None) != (readings[1] is None):
        raise WrongError("one way to read it refuses it, the other does not")
    if readings[0] is None:
        return "refused" if outcome == "refused" else "read, no signals"
    for arrays, one_by_one in zip(*readings, strict=True):
        if np.asarray(arrays).tobytes() != np.asarray(one_by_one).tobytes():
            raise WrongError("read by arrays and by message it says different things")
    return outcome


@cache
def middleware() -> tuple[Any, Any, Any]:
    from rclpy.serialization import deserialize_message

    from uncertain_lti.recordings.message_reader import MessageReader
    from uncertain_lti_ros.topics import live_fields, message_class

    return MessageReader, cache(live_fields), lambda kind: lambda data: deserialize_message(data, message_class(kind))


def read_messages(rng: random.Random, _: Path) -> str:
    """One damaged message after a few whole ones, by the layouts of the live node and by the middleware alone."""
    from uncertain_lti.recordings.message_reader import UnreadableError
    from uncertain_lti.signals.field_path import FieldPath

    make_reader, fields, decoder = middleware()
    kind, paths, make = rng.choice(
        (
            (JOINT_STATE, ("position[a]", "velocity[1]", "position[longer name]"), joint_state),
            (ODOMETRY, ("yaw(pose.pose.orientation)", "twist.twist.linear.x", "pose.covariance[7]"), odometry),
        )
    )
    taken = [FieldPath(text) for text in paths]
    reader = make_reader(kind, taken, fields, decoder(kind))
    for k in range(3):
        reader.read(make(10**18 + k, k))
    data = damaged(rng, make(10**18 + 9, 9), first=rng.choice((0, 4)), aligned=rng.choice((1, 4)))
    recorded = read_recorded(kind, taken, [*(make(10**18 + k, k) for k in range(3)), data])
    try:
        decoded = decoder(kind)(data)
    except Exception:  # whatever the middleware raises
        decoded = None
    try:
        found = reader.read(data)
    except UnreadableError as error:
        if recorded is not None:
            raise WrongError(f"{recorded} in a recording, live {error}; {data.hex()}") from None
        return "refused"
    if decoded is None:
        # The middleware refuses what stands in fields that nobody wants; what was wanted is where it belongs.
        return "read past"
    stamp = decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec or None
    values = [path.read(decoded) for path in taken]
    if found[0] != stamp or np.array(found[1]).tobytes() != np.array(values).tobytes():
        raise WrongError(f"{found} where the middleware says {(stamp, values)}; {data.hex()}")
    if recorded != (stamp, np.array(values).tobytes()):
        raise WrongError(f"{recorded} in a recording, live {found}; {data.hex()}")
    return "read"


@cache
def recorded_definition(kind: str) -> Any:
    from uncertain_lti.recordings.message_types import define, jazzy_text

    return define(kind, "ros2msg", jazzy_text(kind).encode())


def read_recorded(kind: str, paths: list[Any], messages: list[bytes]) -> tuple[int | None, bytes] | None:
    """Stamp and values of the last of these messages of a recording; None where it is left out."""
    from uncertain_lti.recordings.bag_arrays import FieldReader
    from uncertain_lti.recordings.message_reader import NO_STAMP

    ends = np.cumsum([len(data) for data in messages])
    begins = ends - [len(data) for data in messages]
    values, stamps = np.empty((len(messages), len(paths))), np.empty(len(messages), np.int64)
    buffer = bytearray(b"".join(messages))
    failures = FieldReader(recorded_definition(kind), paths).read(buffer, begins, ends, values, stamps)
    if any(row == len(messages) - 1 for row, _ in failures):
        return None
    return None if stamps[-1] == NO_STAMP else int(stamps[-1]), values[-1].tobytes()


def judge_streams(rng: random.Random, folder: Path) -> str:
    """One stream in disorder, live and in a recording."""
    case = rng.choice(CASES)
    ours, theirs = case(np.random.default_rng(rng.randrange(2**32)), folder)
    if found := difference(ours, theirs):
        raise WrongError(f"{case.__name__}: {found}")
    return f"{case.__name__.replace('_', ' ')}, {'with' if any(row['alarm'] for row in ours) else 'without'} an alarm"


DAMAGED: dict[str, Callable[[random.Random, Path], str]] = {
    "files": read_file,
    "structures": read_structure,
    "messages": read_messages,
}
"""Kinds whose cases are read, or refused."""
KINDS = DAMAGED | {"streams": judge_streams}


# --- many cases ---------------------------------------------------------------------------------------------


def work(kind: str, first: int, count: int) -> None:
    """Print `begin SEED`, then `end SEED OUTCOME` or `fail SEED WHY`, of each case."""
    warnings.simplefilter("error", RuntimeWarning)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "signals.yaml").write_text(SIGNALS)
        case = KINDS[kind]
        with contextlib.suppress(Exception):
            case(random.Random(0), folder)  # imports what is imported late
        size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + LIMIT_MEMORY, resource.RLIM_INFINITY))
        faulthandler.register(signal.SIGPROF, chain=True)  # says where it was, then ends it, in C as well
        for seed in range(first, first + count):
            print("begin", seed, flush=True)
            signal.setitimer(signal.ITIMER_PROF, LIMIT_CPU_S)
            faulthandler.dump_traceback_later(LIMIT_S, exit=True)
            try:
                print("end", seed, case(random.Random(seed), folder), flush=True)
            except BaseException as error:
                why = "".join(traceback.format_exception(error)).replace("\n", " | ")
                print("fail", seed, why[-1500:], flush=True)
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_PROF, 0.0)


@dataclass
class Outcome:
    """What became of the cases: how many ended how, and which failed."""

    counts: dict[str, int]
    failures: list[str]
    slowest: float


def run(kind: str, first: int, count: int, program: str = __file__) -> Outcome:
    """Cases of seeds first, first + 1, ... in processes of their own, which run this program."""
    outcome = Outcome({}, [], 0.0)
    while count > 0:
        done = 0
        for seed, said, seconds in _batch(program, kind, first, min(BATCH, count)):
            done += 1
            outcome.slowest = max(outcome.slowest, seconds)
            if said.startswith("end "):
                key = said.removeprefix("end ")
                outcome.counts[key] = outcome.counts.get(key, 0) + 1
            else:
                outcome.failures.append(f"{kind} --seed {seed}: {said.removeprefix('fail ')}")
        first, count = first + max(done, 1), count - max(done, 1)
    return outcome


def _batch(program: str, kind: str, first: int, count: int) -> Iterator[tuple[int, str, float]]:
    """(seed, what was said of it, s) of each case until the process ends, as it does after one that kills it."""
    command = [sys.executable, program, "--work", kind, "--seed", str(first), "--count", str(count)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    assert process.stdout is not None
    open_seed, began, other = first, time.perf_counter(), ""
    is_open = False
    for line in process.stdout:
        word, _, rest = line.strip().partition(" ")
        seed, _, what = rest.partition(" ")
        if word == "begin":
            open_seed, began, is_open = int(seed), time.perf_counter(), True
        elif word in ("end", "fail") and seed == str(open_seed):
            is_open = False
            yield open_seed, f"{word} {what}", time.perf_counter() - began
        else:
            other = f"{other} | {line.strip()}"[-1500:]
    if process.wait() != 0 or is_open:  # `other` holds where it hung
        yield open_seed, f"fail the process ended with {process.returncode}: {other}", time.perf_counter() - began


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=1, help="of the first case")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--work", choices=list(KINDS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.work, options.seed, options.count)
        return 0
    failed = 0
    for kind in options.kinds:
        outcome = run(kind, options.seed, options.count)
        counts = ", ".join(f"{count} {name}" for name, count in sorted(outcome.counts.items()))
        print(f"{kind}: {counts}; {len(outcome.failures)} failed; the slowest took {outcome.slowest:.2f} s")
        for failure in outcome.failures[:20]:
            print(f"  {failure}")
        failed += len(outcome.failures)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
