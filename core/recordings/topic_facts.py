# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Facts about the topics of a recording: rates, gaps, stamps, and the fields that could be signals."""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Iterable, Mapping
from statistics import median

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.message_types import RawMessage
from uncertain_lti.recordings.recording import TopicFacts, TopicInfo
from uncertain_lti.signals.field_path import signal_paths

_BURSTS = 10  # times that the mean step is longer than the median one where messages come in bursts


def topic_facts(topics: Mapping[str, TopicInfo], messages: Iterable[RawMessage]) -> list[TopicFacts]:
    """Facts about every topic of a recording; reads its messages once, and decodes one of each topic.

    Field paths are taken from the longest message of a topic, so that its arrays have their lengths.
    """
    times: dict[str, array[int]] = {topic: array("Q") for topic in topics}
    offsets: dict[str, array[float]] = {topic: array("d") for topic in topics}
    zeros = dict.fromkeys(topics, 0)
    longest: dict[str, RawMessage] = {}
    for raw in messages:
        channel, topic = raw.channel, raw.channel.topic
        if not channel.counted:
            continue
        times[topic].append(raw.log_time_ns)
        if channel.definition.reason:
            continue
        if topic not in longest or len(raw.data) > len(longest[topic].data):
            longest[topic] = raw
        if channel.definition.has_header:
            if stamp := channel.definition.stamp_ns(raw.data):
                offsets[topic].append((raw.log_time_ns - stamp) * 1e-9)
            else:
                zeros[topic] += 1
    return [
        _facts(info, times[topic], offsets[topic], zeros[topic], longest.get(topic)) for topic, info in topics.items()
    ]


def _facts(
    info: TopicInfo, times: array[int], offsets: array[float], zeros: int, longest: RawMessage | None
) -> TopicFacts:
    steps = [b - a for a, b in itertools.pairwise(times)]
    step, bursts = usual_step(median(steps), times[-1] - times[0], len(steps)) if steps else (0.0, False)
    fields: tuple[str, ...] = ()
    if longest:
        definition = longest.channel.definition
        try:
            message = definition.decode(longest.data)
            fields = tuple(signal_paths(definition.fields, definition.type_name, message))
        except BagError:
            pass  # `messages` tells it
    return TopicFacts(
        info,
        rate=1e9 / step if step else None,
        largest_gap=max(steps) * 1e-9 if steps else None,
        fields=fields,
        stamps="mixed" if zeros and offsets else "usable" if offsets else "zero" if zeros else "none",
        stamp_offset=median(offsets) if offsets else None,
        bursts=bursts,
    )


def usual_step(middle: float, span: float, steps: int) -> tuple[float, bool]:
    """Step that a topic's rate is that of: the median one, or the mean where most messages come in bursts."""
    mean = span / steps
    return (mean, True) if 0 <= middle * _BURSTS < mean else (middle, False)
