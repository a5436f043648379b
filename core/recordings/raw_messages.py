# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages as recorded, and what the file says of the channels they were recorded on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from mcap.records import Schema

from uncertain_lti.recordings.message_types import Definition


@dataclass(frozen=True, eq=False)
class RecordedChannel:
    """A channel as the file describes it: everything needed to write its messages again.

    `topic`: name of its topic; `type`: message type, `pkg/msg/Type`; `encoding`: of its messages; `schema`: its record
    in the file; None without one; `metadata`: what the recorder stored of the channel, QoS for example; `definition`:
    how its messages are decoded; `counted`: whether its messages are those of its topic (see `Bag` on topics with
    several types).
    """

    topic: str
    type: str
    encoding: str
    schema: Schema | None
    metadata: Mapping[str, str]
    definition: Definition
    counted: bool = False


class RawMessage(NamedTuple):
    """One message as recorded.

    `log_time_ns`: log time, ns; `publish_time_ns`: publish time, ns; `data`: serialised message; `channel`: what it was
    recorded on.
    """

    log_time_ns: int
    publish_time_ns: int
    data: bytes
    channel: RecordedChannel

    @property
    def topic(self) -> str:
        """Topic it was published on."""
        return self.channel.topic

    @property
    def type(self) -> str:
        """Message type, `pkg/msg/Type`."""
        return self.channel.type

    @property
    def encoding(self) -> str:
        """Encoding of `data`; `cdr` is what can be decoded."""
        return self.channel.encoding
