# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Session of a model file: its topics read by the message types that are installed here."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from functools import cache
from pathlib import Path

from rclpy.serialization import deserialize_message

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.arming import Arming
from uncertain_lti.monitor.session import Rule, Session, topic_types
from uncertain_lti.recordings.message_reader import MessageReader
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti_ros.messages import live_fields, message_class
from uncertain_lti_ros.outputs import sendable
from uncertain_lti_ros.settings import Settings

_type_fields = cache(live_fields)


_PATIENCE = 10.0  # s that a file may take to be read, as on a network that is down


def _load(file: Path) -> UncertainLTI:
    """Read a model file in a thread of its own, so that a file that cannot be read does not hold up the node."""
    loaded: Future[UncertainLTI] = Future()

    def load() -> None:
        try:
            loaded.set_result(UncertainLTI.load(file))
        except Exception as error:
            loaded.set_exception(error)

    threading.Thread(target=load, name="model file", daemon=True).start()
    try:
        return loaded.result(_PATIENCE)
    except TimeoutError:
        raise ModelError(f"{file}: cannot be read within {_PATIENCE:g} s; copy it to a disk of this machine") from None


def make_session(path: str, rule: Rule, settings: Settings, arming: Arming | None = None) -> Session:
    """Load a model file, and start a session with it."""
    if not path:
        raise ModelError("parameter model is empty; give the path of a model file, -p model:=FILE")
    file = Path(path).expanduser()  # no shell does that behind :=
    if not (file.is_absolute() or os.path.exists(file)):
        raise ModelError(f"{path}: there is no such model file in {Path.cwd()}; give the whole path")
    model = _load(file)
    types = topic_types(model, path, _type_fields)
    for names in (model.state_names, model.control_names):
        sendable(names)

    def make_reader(type_name: str, paths: Sequence[FieldPath]) -> MessageReader:
        kind = message_class(type_name)
        return MessageReader(
            type_name, paths, _type_fields, lambda data: deserialize_message(data, kind), settings.largest_message
        )

    return Session(model, rule, types, _type_fields, make_reader, time.monotonic(), arming, settings.real("catch_up"))
