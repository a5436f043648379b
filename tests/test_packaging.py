# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The package that pip and colcon install is whole, says what it needs, and is light to import."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterable
from distutils.core import run_setup  # setuptools brings it where Python no longer does
from functools import cache
from importlib import metadata
from types import SimpleNamespace
from unittest.mock import MagicMock
from xml.etree import ElementTree

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import uncertain_lti

LIVE = [
    f"{room.name}.{path.stem}"
    for room in (ROOT / "core" / name for name in ("base", "signals", "model", "monitor"))
    for path in sorted(room.glob("*.py"))
    if path.stem not in ("__init__", "interchange", "progress")
] + ["sampling.sampler", "sampling.transient", "sampling.steady_state", "recordings.message_reader"]

# Where the name to import is not the name to install.
PIP_NAME = {"yaml": "pyyaml"}
ROSDEP_KEY = {name: f"python3-{name}" for name in ("jinja2", "matplotlib", "numpy", "scipy", "tqdm", "yaml")}
ROSDEP_KEY |= {"markupsafe": "python3-jinja2", "rosbags": "python3-rosbags-pip"}
ROSDEP_KEY |= dict.fromkeys(("cvxpy", "highspy", "osqp"), "python3-cvxpy-pip")
ROSDEP_KEY |= dict.fromkeys(("lz4", "mcap", "zstandard"), "mcap-ros2-support")
WITHOUT_ROSDEP_KEY = {"control", "daqp", "distributed", "piqp", "threadpoolctl"}


@pytest.fixture(scope="module")
def package():
    return ElementTree.parse(ROOT / "package.xml").getroot()


@pytest.fixture(scope="module")
def distribution():
    patch = pytest.MonkeyPatch()
    patch.chdir(ROOT)
    yield run_setup("setup.py", stop_after="init")
    patch.undo()


@cache
def imported(*folders: str) -> dict[str, str]:
    """Top-level names that the Python files import from elsewhere, each with one file that does."""
    names: dict[str, str] = {}
    for path in (path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module]
            names |= {module.partition(".")[0]: str(path.relative_to(ROOT)) for module in modules}
    own = {"uncertain_lti", "uncertain_lti_ros"}
    return {name: path for name, path in names.items() if name not in own | sys.stdlib_module_names}


def run_python(code: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(command, cwd="/", capture_output=True, text=True)


def import_in_fresh_process(module: str, *, allowed: set[str] | None = None, refused: Iterable[str] = ()):
    """Import `module` where the refused packages, or all third-party ones but the allowed, fail to import."""
    result = run_python(f"""
        import sys

        class Blocker:
            def find_spec(self, name, path=None, target=None):
                top = name.partition(".")[0]
                allowed = {allowed!r}
                outside = allowed is not None and top not in sys.stdlib_module_names and top not in allowed
                if outside or top in {set(refused)!r}:
                    raise ModuleNotFoundError(f"{{name}} must not be needed here", name=name)

        sys.meta_path.insert(0, Blocker())
        import {module}
        """)
    assert result.returncode == 0, result.stderr


def test_what_the_live_node_uses_imports_with_numpy_alone():
    modules = ", ".join(f"uncertain_lti.{module}" for module in LIVE)
    import_in_fresh_process(modules, allowed={"uncertain_lti", "numpy"})


def test_the_node_imports_without_solvers_plots_and_bag_readers():
    pytest.importorskip("rclpy", reason="neither a ROS 2 installation nor the rclpy wheels are here")
    heavy = "cvxpy daqp highspy matplotlib mcap osqp pandas piqp rosbags scipy tqdm".split()
    import_in_fresh_process("uncertain_lti_ros.envelope_monitor", refused=heavy)


def test_public_names_resolve_and_others_do_not():
    for name in uncertain_lti.__all__:
        assert getattr(uncertain_lti, name).__module__.startswith("uncertain_lti."), name
        assert name in dir(uncertain_lti)
    with pytest.raises(AttributeError, match="no attribute 'Transients'"):
        _ = uncertain_lti.Transients


def test_core_never_imports_ros():
    ros = re.compile(r"(rcl|ros2|rosidl|launch).*|.*_(msgs|srvs|interfaces)")
    assert not {name: path for name, path in imported("core").items() if ros.fullmatch(name)}


def test_version_is_the_same_everywhere(package, distribution):
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    assert package.findtext("version") == distribution.get_version() == uncertain_lti.__version__ == newest


def test_package_xml_is_what_colcon_accepts(package, distribution):
    assert package.get("format") == "3"
    assert package.findtext("name") == distribution.get_name()
    assert package.findtext("export/build_type") == "ament_python"
    assert package.findtext("license") == distribution.get_license() == "Apache-2.0"
    # catkin_pkg's own pattern; with an address that fails it colcon no longer sees an ament package.
    address = r"[-a-zA-Z0-9_%+]+(\.[-a-zA-Z0-9_%+]+)*@[-a-zA-Z0-9%]+(\.[-a-zA-Z0-9%]+)*\.[a-zA-Z]{2,}"
    assert re.fullmatch(address, package.find("maintainer").get("email"))
    assert package.find("maintainer").get("email") == distribution.get_maintainer_email()
    assert package.findtext("maintainer") == distribution.get_maintainer()
    addresses = {url.get("type"): url.text for url in package.findall("url")}
    assert addresses == {"website": distribution.get_url(), **distribution.metadata.project_urls}
    assert addresses.keys() == {"website", "repository", "bugtracker"}


def test_every_package_and_file_of_the_source_is_installed(distribution):
    homes = {distribution.package_dir.get(name, name): name for name in distribution.packages}
    for top in ("core", "uncertain_lti_ros"):
        for path in (ROOT / top).rglob("*"):
            made = path.suffix == ".so"  # by an installation that is edited in place
            if path.is_dir() or made or "__pycache__" in path.parts or path.name.startswith("."):
                continue
            above = (f for f in path.parents if (f / "__init__.py").exists())
            folder = path.parent if path.suffix == ".py" else next(above)
            home = str(folder.relative_to(ROOT))
            assert home in homes, f"{home} holds {path.name} and is no package"
            patterns = distribution.package_data.get(homes[home], [])
            assert path.suffix == ".py" or any(path.match(pattern) for pattern in patterns), path

    installed = {file for _, files in distribution.data_files for file in files}
    wanted = {p for folder in ("bags", "config", "launch") for p in (ROOT / folder).rglob("*") if p.is_file()}
    wanted = {str(p.relative_to(ROOT)) for p in wanted if "__pycache__" not in p.parts}
    assert wanted | {"package.xml", "resource/uncertain_lti_ros"} == installed
    assert all((ROOT / file).is_file() for file in installed)


def required(distribution) -> list[Requirement]:
    return [Requirement(t) for t in (*distribution.install_requires, *sum(distribution.extras_require.values(), []))]


def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_what_pip_installs_covers_what_is_imported(distribution):
    names = {canonicalize_name(requirement.name) for requirement in required(distribution)} | {"cython"}  # compiles
    missing = {name: path for name, path in imported("core").items() if PIP_NAME.get(name, name) not in names}
    assert not missing


def test_what_monitors_needs_no_package_of_pip(package):
    """And nothing else that apt has but numpy and PyYAML: a robot is not to be filled with solvers."""
    keys = {element.text for element in package.iter("exec_depend")}
    assert {key for key in keys if key.startswith("python3") or "mcap" in key} == {"python3-numpy", "python3-yaml"}
    assert not [key for element in package if (key := element.text or "").endswith("-pip")]


def test_package_xml_covers_what_is_imported(package):
    fitting = ElementTree.parse(ROOT / "rosdep/package.xml").getroot()
    assert fitting.findtext("version") == package.findtext("version")
    keys = {element.text for root in (package, fitting) for element in root.iter("exec_depend")}
    outside = imported("core", "uncertain_lti_ros", "launch")
    # data frames are handed in by who has pandas
    optional = WITHOUT_ROSDEP_KEY | {"isal", "pandas", "pyarrow", "shtab", "cython"}
    missing = {n: p for n, p in outside.items() if n not in optional and ROSDEP_KEY.get(n, n) not in keys}
    assert not missing


def test_constraints_pin_every_requirement_to_a_version_it_allows(distribution):
    pins = {canonicalize_name(name): version for name, version in pinned().items()}
    for requirement in required(distribution):
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement


def test_pinned_versions_run_on_the_python_of_debian_12_and_ubuntu_24_04():
    """A pip that is asked for a version which wants a newer Python says that the requirements conflict."""
    looked = 0
    for name, version in pinned().items():
        try:
            found = metadata.metadata(name)
        except metadata.PackageNotFoundError:
            continue
        wanted = found.get("Requires-Python")
        if found["Version"] == version and wanted:
            looked += 1
            for python in ("3.11.2", "3.12.3"):
                assert SpecifierSet(wanted).contains(python), f"{name} {version} wants Python {wanted}"
    assert looked > 20


def test_what_is_compiled_is_required_and_contracts_nothing(distribution):
    found = distribution.ext_modules
    assert "uncertain_lti.kernel.arithmetic" in [extension.name for extension in found]
    assert not any(extension.optional for extension in found)
    assert all("-ffp-contract=off" in extension.extra_compile_args for extension in found)


def test_without_its_compiled_modules_the_package_says_what_to_install(tmp_path):
    (tmp_path / "uncertain_lti").mkdir()
    shutil.copy(ROOT / "core/__init__.py", tmp_path / "uncertain_lti")
    result = subprocess.run(
        [sys.executable, "-c", "import uncertain_lti"], cwd=tmp_path, capture_output=True, text=True, check=False,
        env={"PATH": "", "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    last = result.stderr.splitlines()[-1]
    assert result.returncode == 1 and "a wheel, or a C compiler and Python's headers" in last and "pip install" in last


def test_the_changelog_of_a_release_is_what_catkin_reads(package):
    """Docutils finds no fault, and sections are versions with a date, or what is to come (REP-132)."""
    convert = runpy.run_path(str(ROOT / "docs" / "changelog.py"))["to_rst"]
    text = (ROOT / "CHANGELOG.md").read_text()
    assert "\nForthcoming\n-----------\n* " in convert(text, package.findtext("name"))
    released = convert(text.replace("(unreleased)", "(2026-01-31)"), package.findtext("name"))
    assert "\n0.2.0 (2026-01-31)\n------------------\n* " in released
    core = pytest.importorskip("docutils.core", reason="docutils comes with the extra docs")
    tree = core.publish_doctree(released, settings_overrides={"report_level": 2, "halt_level": 2})
    (section,) = [*tree.findall(lambda node: node.tagname == "bullet_list" and node.parent.tagname != "list_item")]
    assert len(section.children) == len(re.findall(r"^- ", text, re.MULTILINE))


@pytest.fixture
def launched(monkeypatch):
    """What the launch file defines; `launch` itself comes with ROS 2 alone."""
    for name in ("launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    return runpy.run_path(str(ROOT / "launch/envelope_monitor.launch.py"))


def test_a_launch_ends_with_the_node_that_it_requires(launched):
    """With status 1 after a fault, in order otherwise."""
    ended = launched["ended"]

    def end(status, shutting_down=False):
        event = SimpleNamespace(process_name="envelope_monitor-1", returncode=status)
        return ended(event, SimpleNamespace(is_shutdown=shutting_down))

    with pytest.raises(RuntimeError, match="envelope_monitor-1 is required, and ended with status 2"):
        end(2)
    assert end(0) is sys.modules["launch.actions"].Shutdown.return_value
    assert end(0, shutting_down=True) is end(-2, shutting_down=True) is None, "Ctrl-C ends it already"


def test_a_launch_argument_that_is_no_number_is_named(launched):
    given = {name: default for name, (default, _) in launched["ARGUMENTS"].items()} | {"respawn_delay": "abc"}
    launched["start"].__globals__["LaunchConfiguration"] = lambda name: MagicMock(perform=lambda _: given[name])
    with pytest.raises(ValueError, match="^respawn_delay:=abc is no number; give seconds$"):
        launched["start"](None)


@pytest.mark.parametrize(
    ("pushed", "namespace", "inputs"),
    [("", "robot1", "/robot1"), ("/robot7", "", "/robot7"), ("fleet", "r8/", "/fleet/r8"), ("fleet", "/r8", "/r8")],
)
def test_a_launched_monitor_follows_the_launch_files_around_its_own(launched, pushed, namespace, inputs):
    """Its inputs its namespace, also what PushRosNamespace puts before it, and /clock SetParameter or the file."""
    given = {name: default for name, (default, _) in launched["ARGUMENTS"].items()}
    given |= {"namespace": namespace, "topic_prefix": "namespace"}
    launched["start"].__globals__["LaunchConfiguration"] = lambda name: MagicMock(perform=lambda _: given[name])
    launched["start"](SimpleNamespace(launch_configurations={"ros_namespace": pushed} if pushed else {}))
    file, values = sys.modules["launch_ros.actions"].LifecycleNode.call_args.kwargs["parameters"]
    assert values == {"topic_prefix": inputs}, "and use_sim_time is left to others"
    assert file == given["params_file"]


@pytest.mark.parametrize("robots", ["robot1,", "robot1,robot 2", "robot1,robot-2", "robot1,/robot1/"])
def test_robots_that_cannot_be_launched_are_refused_before_any_is(monkeypatch, robots):
    """The monitor of the first was left running."""
    names = "actions", "launch_description_sources", "substitutions"
    for name in ("launch", *(f"launch.{name}" for name in names)):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    start = runpy.run_path(str(ROOT / "launch/robots.launch.py"))["start"]
    start.__globals__["LaunchConfiguration"] = lambda _: MagicMock(perform=lambda _: robots)
    with pytest.raises(ValueError, match="must name each robot once, in letters"):
        start(None)
    assert not sys.modules["launch.actions"].IncludeLaunchDescription.called
