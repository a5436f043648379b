# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Damage gives a clear error or a correct reading; `python benchmarks/fuzz.py` tries ten thousand of each kind."""

import os
import struct
import sys
from importlib.util import find_spec
from pathlib import Path

import fuzz
import pytest

from uncertain_lti.recordings.message_reader import UnreadableError
from uncertain_lti.signals.field_path import FieldPath


@pytest.mark.parametrize("kind", list(fuzz.DAMAGED))
def test_damage_gives_a_clear_error_or_a_correct_reading(kind: str) -> None:
    if kind == "messages":
        pytest.importorskip("rclpy", reason="rclpy, whose reading layouts are held against, is not installed")
    outcome = fuzz.run(kind, first=20_000, count=20)
    assert not outcome.failures, "\n".join(outcome.failures)
    assert sum(outcome.counts.values()) == 20
    assert outcome.counts["read"] > 4 and outcome.counts["refused"] > 1, "the damage is too small or too great"


def framed(
    frame_id: bytes, start: bytes = b"\0\1\0\0", more: int = 0, name: bytes = b"a\0", repeated: bool = False
) -> bytes:
    """A JointState with this frame_id and this name, as they stand there."""
    order = "<" if start[1] else ">"
    body = struct.pack(f"{order}iII", 5, 7, len(frame_id)) + frame_id
    names = [name, name] if repeated else [name]
    body += bytes(-len(body) % 4) + struct.pack(f"{order}I", len(names))
    for one in names:
        body += bytes(-len(body) % 4) + struct.pack(f"{order}I", len(one)) + one
    body += bytes(-len(body) % 4) + struct.pack(f"{order}I", 1)
    return start + body + bytes(-len(body) % 8) + struct.pack(f"{order}dII", 1.5, 0, 0) + bytes(more)


BIG = b"\0\0\0\0"
needs_rclpy = pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is not installed")
READ = {
    "regular": framed(b"base\0"),
    "Latin-1": framed(b"Tr\xe4ger\0"),
    "no closing zero": framed(b"base"),
    "not even the length of one": framed(b""),
    "zeros": framed(b"base\0\0\0\0"),
    "filled up": framed(b"base\0", more=11),
    "a name without a closing zero": framed(b"base\0", name=b"a"),
    "another name that ends early": framed(b"base\0", name=b"a\0\xff\0"),
    "big-endian": framed(b"base\0", start=BIG),
    "big-endian, filled up": framed(b"base\0", start=BIG, more=11),
    "parameter list": framed(b"base\0", start=b"\0\3\0\0"),
}
REFUSED = {
    "bytes behind": framed(b"base\0", more=12),
    "bytes behind big-endian": framed(b"base\0", start=BIG, more=12),
    "bytes behind names that repeat": framed(b"base\0", more=12, repeated=True),
    "bytes behind odd text": framed(b"", more=12),
    "a length that lies": framed(b"base\0").replace(b"\5\0\0\0base", b"\xff\0\0\0base"),
    "another encapsulation": framed(b"base\0", start=b"\0\7\0\0"),
    "another encapsulation that the middleware takes": framed(b"ba\0", start=b"\0\7\0\0"),
    "too short": framed(b"base\0")[:40],
    "nothing": b"",
}


@needs_rclpy
def test_odd_messages_read_alike_live_and_from_recordings() -> None:
    make_reader, fields, decoder = fuzz.middleware()
    paths = [FieldPath("position[a]")]
    live = make_reader(fuzz.JOINT_STATE, paths, fields, decoder(fuzz.JOINT_STATE))
    for _ in range(2):  # the second time the live node knows the layouts
        for what, data in READ.items():
            stamp, values = live.read(data)
            assert (stamp, list(values)) == (5_000_000_007, [1.5]), what
        for what, data in REFUSED.items():
            with pytest.raises(UnreadableError):
                raise AssertionError(f"{what}: {live.read(data)}")
    for what, data in (READ | REFUSED).items():
        for before in ([], [READ["regular"]] * 3, list(READ.values()), list(REFUSED.values())):
            recorded = fuzz.read_recorded(fuzz.JOINT_STATE, paths, [*before, data])
            assert recorded == ((5_000_000_007, struct.pack("<d", 1.5)) if what in READ else None), what


def made(kind: str, *values: object) -> bytes:
    """A message of the middleware with these values in its fields, in order."""
    from rclpy.serialization import serialize_message

    from uncertain_lti_ros.topics import message_class

    message = message_class(kind)()
    for name, value in zip(message.get_fields_and_field_types(), values, strict=False):
        setattr(message, name, value)
    return bytes(serialize_message(message))


def read_alike(kind: str, path: str, data: bytes, before: list[bytes]) -> float | None:
    """What live and a recording read of a message, which must be the same; None where both refuse it."""
    make_reader, fields, decoder = fuzz.middleware()
    live = make_reader(kind, [FieldPath(path)], fields, decoder(kind))
    for one in before:
        live.read(one)
    recorded = fuzz.read_recorded(kind, [FieldPath(path)], [*before, data])
    try:
        _, (value,) = live.read(data)
    except UnreadableError as error:
        assert recorded is None, (data.hex(), recorded, str(error))
        return None
    assert recorded is not None and recorded[1] == struct.pack("<d", value), (data.hex(), recorded, value)
    return float(value)


@needs_rclpy
def test_a_cut_message_is_refused_live_and_of_recordings() -> None:
    """Also where the middleware takes the bytes that are missing for zeros."""
    from geometry_msgs.msg import Point32, Polygon
    from std_msgs.msg import Header

    polygon = Polygon(points=[Point32(x=1.0), Point32(x=2.0)])
    whole = {
        ("shape_msgs/msg/SolidPrimitive", "type"): made("shape_msgs/msg/SolidPrimitive", 1, [0.5, 0.25], polygon),
        ("sensor_msgs/msg/JointState", "position[0]"): made(
            "sensor_msgs/msg/JointState", Header(), ["a"], *[[1.5]] * 3
        ),
    }
    for (kind, path), data in whole.items():
        for before in ([], [data] * 2):
            assert read_alike(kind, path, data, before) is not None
            for size in range(4, len(data)):
                assert read_alike(kind, path, data[:size], before) is None, size


@needs_rclpy
def test_a_byte_is_a_number_live_as_of_recordings() -> None:
    for kind, path in (("std_msgs/msg/Byte", "data"), ("diagnostic_msgs/msg/DiagnosticStatus", "level")):
        data = made(kind, b"\7")
        assert read_alike(kind, path, data, []) == read_alike(kind, path, data, [data] * 2) == 7.0


@needs_rclpy
@pytest.mark.parametrize("path", ["present", "voltage"])
def test_a_truth_value_of_2_is_refused_live_and_of_recordings(path: str) -> None:
    """Wanted or not, whether messages like it are known or not."""
    from std_msgs.msg import Header

    kind = "sensor_msgs/msg/BatteryState"
    # texts of three letters and a zero leave no padding, whose bytes are whatever was there
    whole = Header(frame_id="bat"), *[1.5] * 7, 1, 1, 1
    true, false = (made(kind, *whole, present, [], [], "bay", "one") for present in (True, False))
    (at,) = (i for i in range(len(true)) if true[i] != false[i])
    for before in ([], [true] * 3, [false] * 3, [true, false] * 3):
        assert read_alike(kind, path, true, before) == (1.0 if path == "present" else 1.5)
        assert read_alike(kind, path, false, before) == (0.0 if path == "present" else 1.5)
        for odd in (2, 255):
            assert read_alike(kind, path, true[:at] + bytes([odd]) + true[at + 1 :], before) is None


def test_whatever_goes_wrong_is_noticed(tmp_path: Path) -> None:
    """The harness itself, on cases that do what no case may do."""
    program = tmp_path / "wrong.py"
    program.write_text("""
import os, fuzz
fuzz.LIMIT_CPU_S = 0.5
def wrong(rng, folder):
    kind = next(kinds)
    if kind == "raise":
        raise KeyError("nobody raised this on purpose")
    if kind == "die":
        os._exit(3)
    if kind == "compute":
        while True:
            pass
    if kind == "ask for much":
        bytearray(fuzz.LIMIT_MEMORY + 1)
    return "read"
kinds = iter(())
fuzz.KINDS["wrong"] = wrong
if __name__ == "__main__":
    import sys
    seed = int(sys.argv[sys.argv.index("--seed") + 1])
    kinds = iter(["fine", *["raise", "ask for much", "fine", "compute", "die", "fine"][seed:]])
    raise SystemExit(fuzz.main())
""")
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        outcome = fuzz.run("wrong", first=0, count=6, program=str(program))
    assert outcome.counts == {"read": 2}
    expected = [(0, "KeyError"), (1, "MemoryError"), (3, "ended with -27"), (4, "ended with 3")]
    for failure, (seed, why) in zip(outcome.failures, expected, strict=True):
        assert f"--seed {seed}:" in failure and why in failure
