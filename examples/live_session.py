# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Run what the live node runs, without ROS: serialised messages of a bag in, verdicts and diagnostics out.

The node adds subscriptions, clocks and publishers to such a session, and nothing that changes a verdict: the session is
compared here with a check of the same bag, sample by sample and to the last bit.
"""

from pathlib import Path

import numpy as np

from uncertain_lti import EnvelopeMonitor, UncertainLTI, fit, read_transients
from uncertain_lti.monitor.session import Rule, Session, topic_types
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_reader import MessageReader
from uncertain_lti.sampling.reading import read_as_fitted

ROOT = Path(__file__).resolve().parents[1]


def session_for(model: UncertainLTI, bag: Bag, rule: Rule, now: float) -> Session:
    """Make a session whose messages are defined in a recording; the node takes the installed definitions.

    Parameters
    ----------
    model : UncertainLTI
        Fitted to a recording, so that it knows its topics and types.
    bag : Bag
        Defines the types.
    rule : Rule
        The alarm rule.
    now : float
        A steady time, s.

    Returns
    -------
    Session
        Without any message yet.
    """
    definitions = {raw.topic: raw.channel.definition for raw in bag.raw_messages(model.signals.topics)}
    decoders = {definition.type_name: definition.decode for definition in definitions.values()}

    def fields(type_name):
        return next(d for d in definitions.values() if type_name in d.types).fields(type_name)

    def make_reader(type_name, paths):
        return MessageReader(type_name, paths, fields, decoders[type_name])

    return Session(model, rule, topic_types(model, "the model", fields), fields, make_reader, now)


def main() -> None:
    """Fit, run a session over a bag with a fault at 24 s, and compare it with a check."""
    healthy = sorted((ROOT / "bags").glob("turbofan_*_noise.mcap"))
    model = fit(read_transients(healthy, ROOT / "config" / "signals" / "turbofan.yaml"))
    bag = Bag(ROOT / "bags" / "turbofan_fan_damage.mcap")
    messages = list(bag.raw_messages(model.signals.topics))
    began = messages[0].log_time_ns
    session = session_for(model, bag, Rule(violations=2, window=5), now=0.0)

    live = []
    for message in messages:
        now = (message.log_time_ns - began) * 1e-9
        verdicts, _ = session.take(message.topic, message.log_time_ns, message.data, now)
        live += verdicts
        for before, verdict in zip(live[-len(verdicts) - 1 :], verdicts, strict=False):
            if verdict.alarm and not before.alarm:
                print(f"alarm at {(verdict.t_ns - live[0].t_ns) * 1e-9:.3f} s")
    for report in session.report(now, state_timeout=1.0):
        print(f"{report.name}: {report.message}")

    check = EnvelopeMonitor(model, violations=2, window=5).check(read_as_fitted(bag, model.signals))
    same = np.array_equal([v.lower for v in live], check.lower, equal_nan=True)
    same &= np.array_equal([v.upper for v in live], check.upper, equal_nan=True)
    same &= np.array_equal([v.alarm for v in live], check.alarm)
    print(f"{len(live)} samples, {'the same bits as' if same else 'NOT as'} a check of the bag")


if __name__ == "__main__":
    main()
