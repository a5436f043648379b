# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Blocks read ahead and many at once: whole or damaged, a file reads as it does message by message."""

import random
import subprocess
import sys
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
from bag_writer import Layout, float64, record
from by_message import read_stream_by_message
from test_reading import FLOAT64, JOINT_STATE, MS, joint_state, save

import uncertain_lti.recordings.bag_arrays
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.sampling.reading import Stream, read_stream
from uncertain_lti.signals.signal_map import Signal, SignalMap

XU = SignalMap((Signal("x", "/x", "position[2]"),), (Signal("u", "/u", "data"),))


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a short file has many."""
    monkeypatch.setattr(uncertain_lti.recordings.bag_arrays, "_BATCH", 6000)


def recording(folder: Path, compression: str, chunk_size: int) -> Path:
    dice = np.random.default_rng(0)
    messages = []
    for k in range(1, 400):
        names = ["base_link", "odom", "map"][: k % 3]
        messages.append(("/x", k * MS, joint_state(k * MS, [0.0, k, dice.normal()], names)))
        messages.append(("/u", k * MS, float64(dice.normal())))
    layout = Layout(compression, chunk_size=chunk_size)
    return save(folder, {"/x": JOINT_STATE, "/u": FLOAT64}, messages, f"{compression}_{chunk_size}.mcap", layout)


def plain(stream: Stream) -> tuple[bytes, ...]:
    return tuple(array.tobytes() for array in (stream.topic, stream.arrival, stream.stamp, *stream.values))


def outcome(path: Path, by_message: bool) -> tuple[bytes, ...] | str:
    try:
        return plain((read_stream_by_message if by_message else read_stream)(Bag(path, indexed=not by_message), XU))
    except BagError as error:
        return str(error)


def test_a_record_without_content_at_the_end_of_a_block_is_whole() -> None:
    block = record(0x80, b"\0") + record(0x80, b"")
    assert walk_records(block, 0, len(block), 9)[-2:] == (2, len(block))


def test_lz4_frames_without_their_end_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gives all of its records, and the next one is not taken for its continuation."""
    whole = outcome(recording(tmp_path, "lz4", 5000), by_message=False)
    compress = lz4.frame.compress
    marks = []

    def unended(data: bytes) -> bytes:
        packed = compress(data)
        marks.append(packed[-4:])
        return bytes(packed[:-4])

    monkeypatch.setattr(lz4.frame, "compress", unended)
    path = recording(tmp_path, "lz4", 5000)
    assert len(marks) > 5 and set(marks) == {bytes(4)}
    assert outcome(path, by_message=False) == outcome(path, by_message=True) == whole


def test_the_same_without_isal(tmp_path: Path) -> None:
    """Whole and with a bit flipped, which a checksum tells."""
    path = recording(tmp_path, "zstd", 5000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    code = f"""
import sys
sys.modules["isal"] = None
sys.path[:0] = {sys.path!r}
from pathlib import Path
from test_mcap_batches import outcome
from uncertain_lti.recordings.mcap_scan import crc32
assert crc32.__module__ == "zlib", crc32.__module__
print([outcome(Path(path), False) for path in {[str(path), str(damaged)]!r}])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    here = [outcome(path, by_message=False), outcome(damaged, by_message=False)]
    assert here[0] != here[1] and done.stdout == f"{here}\n"


@pytest.mark.parametrize("chunk_size", [300, 5000, 50_000])
@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_whole_and_damaged_files(tmp_path: Path, compression: str, chunk_size: int) -> None:
    """Bits flipped, cut, sizes that lie, bytes missing: the same reading or the same sentence."""
    path = recording(tmp_path, compression, chunk_size)
    found, whole = outcome(path, by_message=False), path.read_bytes()
    assert not isinstance(found, str) and found == outcome(path, by_message=True)
    dice = random.Random(chunk_size)
    path = tmp_path / "damaged.mcap"
    for damage in range(20 if chunk_size < 50_000 else 4):
        data = bytearray(whole)
        at = dice.randrange(len(data) - 8)
        if damage % 4 == 0:
            data[at] ^= 1 << dice.randrange(8)
        elif damage % 4 == 1:
            del data[at:]
        elif damage % 4 == 2:
            data[at : at + 8] = dice.choice([b"\xff" * 8, bytes(8), (1 << 40).to_bytes(8, "little")])
        else:
            del data[at : at + dice.randint(1, 300)]
        path.write_bytes(data)
        assert outcome(path, by_message=False) == outcome(path, by_message=True), f"damage {damage} at {at}"
