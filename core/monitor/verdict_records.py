# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of many verdicts at once, as records of a recording; the bytes are those of `verdict_messages`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.monitor.outputs import FLAG_TYPE, RECORDED, names_of
from uncertain_lti.monitor.verdict_messages import FALSE, FIRST_S, LAST_S, NamedVector
from uncertain_lti.recordings.mcap_writer import INDEX_ENTRY, MESSAGE_HEAD

_MESSAGE = 5  # opcode
_NAN = float("nan")


class VerdictRecords:
    """MCAP message records of many verdicts at once, with the bytes that `VerdictMessages` gives one by one.

    `names`: of the states; `channels`: number of the channel of each of `RECORDED` that is to be there, by name;
    `steps`: of the model's horizons; `statistics`: names of the statistics of the alarm.
    """

    def __init__(
        self,
        names: Sequence[str],
        channels: Mapping[str, int],
        steps: Sequence[int] = (),
        statistics: Sequence[str] = (),
    ) -> None:
        self._n, every = len(names), names_of(names, steps, statistics)
        chosen = [o for o in RECORDED if o.name in channels and o.when != "changed"]
        self._outputs = [o for o in chosen if not o.position or every[o.of]]
        self._channels = [channels[output.name] for output in self._outputs]
        self._count = [0] * len(self._outputs)
        self._vectors = {o.name: NamedVector(every[o.of], bool(o.velocity)) for o in self._outputs if o.position}
        row = bytearray()
        self._begins: list[int] = []
        self._unjudged = 0  # bytes of the records without a verdict, which come first
        for output, channel in zip(self._outputs, self._channels, strict=True):
            data = FALSE if output.type == FLAG_TYPE else self._vectors[output.name].template
            self._begins.append(len(row))
            row += MESSAGE_HEAD.pack(_MESSAGE, MESSAGE_HEAD.size - 9 + len(data), channel, 0, 0, 0) + data
            if output.when == "message":
                assert self._unjudged == self._begins[-1], "OUTPUTS has those of every clock message first"
                self._unjudged = len(row)
        self._row = np.frombuffer(bytes(row), dtype=np.uint8)

    @property
    def size(self) -> int:
        """Bytes of the records of one verdict."""
        return len(self._row)

    def encode(
        self,
        log_time: NDArray[np.int64],
        t_ns: NDArray[np.int64],
        judged: NDArray[np.bool_],
        alarm: NDArray[np.bool_],
        numbers: Mapping[str, NDArray[np.generic]],
    ) -> tuple[bytes, dict[int, bytes]]:
        """Records of K verdicts in rising log time.

        `log_time` (K,): ns; `t_ns` (K,): instants of the samples, ns; `judged` (K,): whether there is a verdict; the
        numbers of the others are published as NaN; `alarm` (K,): as in `Verdicts`.
        """
        count = len(log_time)
        rows = np.tile(self._row, (count, 1))
        seconds, nanoseconds = np.divmod(t_ns, 1_000_000_000)
        seconds = np.clip(seconds, FIRST_S, LAST_S)
        lengths = np.where(judged, self.size, self._unjudged)
        starts = np.cumsum(lengths) - lengths
        index: dict[int, bytes] = {}
        for kind, (output, begin) in enumerate(zip(self._outputs, self._begins, strict=True)):
            published = judged if output.when == "judged" else np.ones(count, dtype=bool)
            _fill(rows, begin + 11, (self._count[kind] + np.cumsum(published) - 1).astype("<u4"))
            self._count[kind] += int(published.sum())
            for place in (begin + 15, begin + 23):
                _fill(rows, place, log_time.astype("<u8"))
            data = begin + MESSAGE_HEAD.size
            if output.type == FLAG_TYPE:
                rows[:, data + 4] = alarm
            else:
                vector = self._vectors[output.name]
                _fill(rows, data + 4, seconds.astype("<i4"))
                _fill(rows, data + 8, nanoseconds.astype("<u4"))
                position = np.where(judged[:, None], numbers[output.position].reshape(count, -1), _NAN)
                _fill(rows, data + vector.position, position.astype("<f8"))
                if output.velocity:
                    velocity = np.where(judged, numbers[output.velocity], _NAN)
                    _fill(rows, data + vector.velocity, np.repeat(velocity[:, None], self._n, axis=1).astype("<f8"))
            entries = np.column_stack([log_time[published], starts[published] + begin]).astype("<u8")
            if len(entries):
                index[self._channels[kind]] = entries.tobytes()
            assert INDEX_ENTRY.size == 8 * entries.shape[1]
        if judged.all():
            return rows.tobytes(), index
        kept = np.arange(self.size) < lengths[:, None]
        return rows[kept].tobytes(), index


def _fill(rows: NDArray[np.uint8], place: int, values: NDArray[np.generic]) -> None:
    """Write one number, or one vector, into each row from this byte on."""
    data = np.ascontiguousarray(values).view(np.uint8).reshape(len(rows), -1)
    rows[:, place : place + data.shape[1]] = data
