# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fixtures that several test files share, and what holds for every test: loopback only, no process left behind."""

import json
import os
import shutil
import signal
import threading
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from processes import adopt_orphans, children, end_children

# A busy machine is no bug.
_UNIMPORTANT = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
settings.register_profile("here", deadline=None, suppress_health_check=_UNIMPORTANT)
settings.load_profile("here")

# No test is heard beyond this machine, whoever started it. The number of the domain is for each test to take.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = "101"  # of what takes none; `own_domain` gives others
for name in ("ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER"):
    os.environ.pop(name, None)

# A shell starts what is to run in its background with SIGINT ignored, and all that this starts would inherit it.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

adopt_orphans()

ROOT = Path(__file__).resolve().parents[1]


# What another numpy can change: arithmetic, files, the kernel, and the node, as ROS on Ubuntu has numpy 1.26. Of the
# sampler and of field paths `reading` and `cdr_arrays` show it.
_NUMPY = """
    cdr_arrays horizons kernel model monitor node_stream operating_point reading schedule transient
""".split()
_SOME_NUMPY = ["interchange"]  # with tests that are marked one by one


# Their fixtures cost more than their tests: side by side each worker would make them again.
_TOGETHER = "archive containers injected_faults packaging progress reproduce turbofan validation".split()

# They wait for processes of ROS 2 most of the time: half of the workers do, while the others compute.
_WAITING = "live monitor_faults node_interface other_vendor play_record security_policy".split()


def stem(path: str) -> str:
    return Path(path).stem.removeprefix("test_")


def pytest_itemcollected(item: pytest.Item) -> None:
    if stem(str(item.path)) in _NUMPY:
        item.add_marker("numpy")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Of a pass by the marker numpy, files without such a test: to import them takes as long as the pass."""
    only = config.option.markexpr.startswith("numpy") and collection_path.suffix == ".py"
    return True if only and stem(str(collection_path)) not in (*_NUMPY, *_SOME_NUMPY) else None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        """Hand out tests one by one, but for those that share a fixture and those that wait."""

        def _split_scope(self, nodeid: str) -> str:
            file = stem(nodeid.partition("::")[0])
            if file in _WAITING:
                return f"waiting {zlib.crc32(nodeid.encode()) % max(1, self.numnodes // 2)}"
            return file if file in _TOGETHER else nodeid

    return Scheduling(config, log)


_FAILED = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed:
        item.stash[_FAILED] = True
    return report


@pytest.fixture(autouse=True)
def no_process_outlives_its_test(request: pytest.FixtureRequest) -> Iterator[None]:
    """Set up before the other fixtures of a test, and so torn down after them."""
    before = children()
    yield
    failed = request.node.stash.get(_FAILED, False)
    left = end_children(before, patience=0.0 if failed else 60.0)
    assert failed or not left, f"the test left processes behind: {'; '.join(left)}"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the real recordings, which are not part of the repository."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real recordings (../shared/data) are not here")
    return folder


@pytest.fixture(scope="session")
def signals_folder() -> Path:
    return ROOT / "config" / "signals"


class Command:
    """Run a command of `uncertain-lti` here: what is on standard output and error, once its status is as wanted."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: Any, status: int = 0) -> Any:
        from uncertain_lti.cli.main import main

        assert main([*map(str, words)]) == status
        return self._capsys.readouterr()

    def json(self, *words: Any, status: int = 0) -> Any:
        return json.loads(self(*words, "--json", status=status).out)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(capsys)


@pytest.fixture(scope="session")
def engine_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """signals.yaml, run.mcap, its m.model.json, and bad.mcap, of which the fan jumps for three samples."""
    import numpy as np
    from engine_bag import SIGNALS, engine_bag

    from uncertain_lti.cli.main import main

    folder = tmp_path_factory.mktemp("engine")
    (folder / "signals.yaml").write_text(SIGNALS)
    engine_bag(folder / "run.mcap")
    engine_bag(folder / "bad.mcap", change=lambda k, x: x + (5.0 if 100 <= k < 103 else 0.0) * np.eye(5)[0])
    words = ["--signals", str(folder / "signals.yaml"), "--additive", "noise", "--alarm", "containment", "-q"]
    assert main(["fit", str(folder / "run.mcap"), *words, "--output", str(folder / "m.model.json")]) == 0
    return folder


@pytest.fixture
def folder(engine_folder: Path, tmp_path: Path) -> Path:
    """A copy of `engine_folder` to write to."""
    return Path(shutil.copytree(engine_folder, tmp_path / "engine"))
