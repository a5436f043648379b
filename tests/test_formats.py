# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A format of recordings is one entry in a table: a subclass of `Recording` is read, fitted, checked and proposed."""

import csv
import math
import shutil
from collections import namedtuple
from itertools import pairwise

import numpy as np
import pytest
from conftest import ROOT
from refusals import refuses

from uncertain_lti import SignalMap, read_transients
from uncertain_lti.base.errors import BagError
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.recordings import formats
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.formats import Format, group_recordings, open_recording
from uncertain_lti.recordings.recording import Columns, Recording, TopicFacts, TopicInfo
from uncertain_lti.signals.field_path import FieldType

TOPIC, SECOND = "/table", 10**9


class Table(Recording):
    """A log, comma-separated, whose first column is the time in s."""

    def __init__(self, path):
        self.path, self.parts = path, (path,)
        self.size = path.stat().st_size
        self._warnings = []
        with open(path, newline="") as stream:
            (_, *self.names), *rows = csv.reader(stream)
        self.rows = [[float(value) for value in row] for row in rows]
        self.times = [round(row[0] * SECOND) for row in self.rows]
        info = TopicInfo(TOPIC, "table", len(rows), "csv", True, "", self.times[0], self.times[-1])
        self.topics = {TOPIC: info}

    def type_fields(self, topic):
        if topic != TOPIC:
            raise BagError(f"{self.path}: there is no topic {topic}; topics there: {TOPIC}")
        return lambda type_name: {name: FieldType("number", "float64") for name in self.names}

    def messages(self, topics):
        row = namedtuple("Row", self.names)
        return ((TOPIC, t, row(*values)) for t, (_, *values) in zip(self.times, self.rows, strict=True))

    def columns(self, topics, paths, progress=None):
        values = np.array([[path.read(m) for path in paths[0]] for _, _, m in self.messages(topics)])
        count = len(self.times)
        return Columns(np.zeros(count, dtype=np.int64), np.array(self.times), np.full(count, -1), [values])

    def facts(self, progress=None):
        steps = [b - a for a, b in pairwise(self.times)]
        return [TopicFacts(self.topics[TOPIC], SECOND / steps[0], max(steps) / SECOND, tuple(self.names), "none", None)]


@pytest.fixture
def tables(monkeypatch):
    known = Format("log", lambda path: path.suffix == ".log", lambda paths, *_: [Table(p) for p in paths])
    monkeypatch.setattr(formats, "FORMATS", [known, *formats.FORMATS])


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "run.log"
    x, u = 0.0, 0.0
    with open(path, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["t", "speed_state", "cmd"])
        for k in range(600):
            u = math.copysign(1.0, math.sin(k / 17))
            writer.writerow([k * 0.02, x, u])
            x += 0.02 * (-2.0 * x + 3.0 * u)
    return path


@pytest.mark.usefixtures("tables")
def test_a_format_added_to_the_table_serves_every_command(run, tmp_path, cli):
    assert isinstance(open_recording(run), Table)
    signals = tmp_path / "signals.yaml"
    signals.write_text(
        "states:\n  - {name: speed, topic: /table, field: speed_state}\n"
        "controls:\n  - {name: command, topic: /table, field: cmd}\n"
    )
    (transient,) = read_transients(run, SignalMap.load(signals))
    assert len(transient.x) == 600 and fit([transient]).A[0, 0] == pytest.approx(-2.0, abs=1e-6)
    model = tmp_path / "m.model.json"
    assert main(["topics", str(run)]) == 0
    assert main(["fit", str(run), "--signals", str(signals), "--additive", "noise", "--output", str(model)]) == 0
    assert "599 verdicts, 100.000% inside all bounds" in cli("check", model, run).out
    assert main(["init", str(run)]) in (0, 2)  # one topic cannot be both state and command: a file or a sentence


@pytest.mark.usefixtures("tables")
def test_recordings_of_several_formats_are_named_together(run, tmp_path):
    bag = ROOT / "bags" / "leibov_check.mcap"
    assert [type(r) for r in group_recordings([run, bag])] == [Table, Bag]
    refuses(BagError, "named twice", group_recordings, [run, bag, run])
    again = shutil.copy(bag, tmp_path / "again.mcap")  # it would vouch for itself in what is left out
    with pytest.raises(BagError, match=r"again\.mcap: holds the samples of .*leibov_check\.mcap; name each"):
        read_transients([bag, again], ROOT / "config" / "signals" / "engine.yaml")


def test_without_an_entry_the_file_is_refused_in_a_sentence(run):
    refuses(BagError, r"run\.log: a text file, while a recording is wanted", open_recording, run)
