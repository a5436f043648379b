# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A recording read message by message: the naive reference for what `read_stream` takes from blocks of messages."""

from array import array

import numpy as np

from uncertain_lti.recordings.message_reader import header_stamp_ns
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.sampling.reading import Stream, check_paths, refuse_absent
from uncertain_lti.signals.signal_map import SignalMap


def read_stream_by_message(bag: Recording, signals: SignalMap) -> Stream:
    """What `read_stream` gives, to the last bit."""
    paths = check_paths(bag, signals)
    topics = signals.topics
    order, arrival, stamp = array("q"), array("q"), array("q")
    values = [array("d") for _ in topics]
    for name, log_time, message in bag.messages(topics):
        where = topics.index(name)
        if all(path.absent(message).startswith("there is no '") for path in paths[where]):
            continue  # of another publisher
        order.append(where)
        arrival.append(log_time)
        stamp.append(header_stamp_ns(message) or -1)
        values[where].extend([path.read(message) for path in paths[where]])
    arrays = [np.array(v).reshape(-1, len(p)) for v, p in zip(values, paths, strict=True)]
    refuse_absent(bag, signals, paths, arrays)
    return Stream(np.array(order), np.array(arrival), np.array(stamp), arrays, bag=bag)
