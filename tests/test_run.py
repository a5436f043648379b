# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`./run` says in one sentence, with the remedy, what keeps it from starting; status 2."""

import os
import platform
import re
import shutil
import signal
import ssl
import subprocess
import sys
import sysconfig
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from conftest import ROOT

VERSION = "{}.{}".format(*sys.version_info)

here = platform.system(), platform.machine()
pytestmark = pytest.mark.skipif(here != ("Linux", "x86_64"), reason="the rclpy wheels are for x86_64 Linux")

LISTED = re.findall(r'^    "(\w+)\.(\w+)": "-O', (ROOT / "setup.py").read_text(), re.MULTILINE)
COMPILED = [
    str(path.relative_to(ROOT))
    for path in sorted((ROOT / "core").rglob("*.p[yx]*"))
    if path.suffix in (".pyx", ".pxi") or path.suffix == ".py" and (path.parent.name, path.stem) in LISTED
]


def test_what_is_compiled_makes_the_environment_anew_when_it_changes():
    (files,) = re.findall(r"\$\(cat (.*) \| cksum\)", (ROOT / "run").read_text())
    listed = subprocess.run(["bash", "-c", f"ls {files}"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert len(COMPILED) > 12 and set(COMPILED) <= set(listed.stdout.split())


@pytest.fixture
def run(tmp_path):
    """Call `./run` in a fresh folder, on a machine with nothing but the shell's own tools and `programs`."""
    checkout = tmp_path / "a checkout"
    checkout.mkdir()
    for name in ("run", "setup.py", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, checkout)
    for name in COMPILED:
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, checkout / name)
    bin = tmp_path / "bin"
    bin.mkdir()
    compiler = (sysconfig.get_config_var("CC") or "cc").split()[0]  # Debian's Python names its own
    for tool in {*"bash cat cksum dirname env gcc grep rm sed tail uname".split(), compiler}:
        (bin / tool).symlink_to(shutil.which(tool))

    def call(*arguments: str, programs: dict[str, str] | None = None, cwd: Path | None = None, **environment: str):
        for name, text in (programs or {}).items():
            (bin / name).write_text(f"#!{bin}/bash\n{text}\n")
            (bin / name).chmod(0o755)
        env = {"PATH": str(bin), "HOME": str(tmp_path), "PIP_CONFIG_FILE": os.devnull, **environment}
        options = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
        return subprocess.run([checkout / "run", *arguments], env=env, cwd=cwd, **options)

    return call


def this_python(setting: str = "") -> str:
    """Shell text that is the interpreter running this test, with an environment setting before it."""
    return f'{setting} exec "{Path(sys.executable).resolve()}" "$@"'


def refusal(result: subprocess.CompletedProcess) -> str:
    """The one sentence with which `./run` stopped."""
    assert result.returncode == 2, result
    sentence = result.stderr.strip()
    assert sentence.startswith("./run: ") and "\n" not in sentence, sentence
    return sentence


def test_help_lists_the_commands(run):
    result = run()
    assert result.returncode == 0 and result.stdout == run("--help").stdout
    for command in ("demo", "test", "docs", "lint", "setup"):
        assert f"\n  {command}" in result.stdout


def without(module: str, folder: Path) -> str:
    """Shell text that is this interpreter without a module of the standard library."""
    (folder / f"{module}.py").write_text("raise ModuleNotFoundError\n")
    return this_python(f'PYTHONPATH="{folder}"')


OLD, HUMBLE = "[[ $2 == *version_info* ]] && echo 3.14", "[[ $2 == 'import rclpy' ]] || echo 3.10"
SOURCED = {"ROS_DISTRO": "humble"}


@pytest.mark.parametrize(
    ("words", "programs", "environment", "says"),
    [
        ("tset", {}, {}, "no command 'tset'"),
        ("setup all", {"python3": this_python()}, {}, "setup takes --all or --monitor, and not 'all'"),
        ("setup", {}, {}, "apt-get install python3 python3-dev gcc$"),
        ("setup", {"python3": OLD, "python3.12": "exit 127"}, {}, "3.11, 3.12 or 3.13 is needed, python3 is 3.14;"),
        ("setup", {"python3": "venv"}, {}, rf"apt-get install python{VERSION}-venv$"),
        ("setup", {"python3": OLD, f"python{VERSION}": "venv"}, {}, f"Python {VERSION} has no venv module"),
        ("setup", {"python3": HUMBLE, "python3.11": this_python()}, SOURCED, "humble runs on Python 3.10"),
        (
            "setup",
            {"python3": this_python("CC=no-such-compiler")},
            {},
            f"a C compiler.*apt-get install gcc python{VERSION}-dev$",
        ),
    ],
    ids=["command", "option", "no Python", "versions", "venv", "its own name", "ROS 2", "compiler"],
)
def test_what_is_lacking_is_a_sentence_with_the_remedy(run, tmp_path, words, programs, environment, says):
    programs = {name: without(text, tmp_path) if text == "venv" else text for name, text in programs.items()}
    assert re.search(says, refusal(run(*words.split(), programs=programs, **environment)))


def test_python_without_ensurepip_takes_pip_from_the_index(run, tmp_path):
    """As Debian ships it without python3-venv; the index offers no wheel of pip, and then none that is what it says."""
    page, asked = [b""], []

    class Index(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(page[0])

    with ThreadingHTTPServer(("127.0.0.1", 0), Index) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        index = {"PIP_INDEX_URL": f"http://127.0.0.1:{server.server_address[1]}/simple"}
        programs = {"python3": without("ensurepip", tmp_path)}
        first = run("setup", programs=programs, **index)
        link = '<a href="../../p/pip-{}-py3-none-any.whl#sha256={}">'
        page[0] = b"".join(link.format(v, "0" * 64).encode() for v in ("9.0", "25.1"))
        second = run("setup", programs=programs, **index)
        server.shutdown()
    assert first.returncode == second.returncode == 2
    assert first.stderr.strip().endswith("/simple/pip/ lists no wheel of pip")
    assert "pip-25.1-py3-none-any.whl is not what" in second.stderr.splitlines()[-1]
    assert asked == ["/simple/pip/", "/simple/pip/", "/p/pip-25.1-py3-none-any.whl"]


def test_no_network(run):
    pytest.importorskip("ensurepip", reason="this Python cannot make virtual environments")
    nowhere = {"PIP_INDEX_URL": "http://127.0.0.1:9", "PIP_RETRIES": "1"}
    sentence = refusal(run("setup", programs={"python3": this_python()}, **nowhere))
    assert "no package index can be reached" in sentence and "connect this machine" in sentence


def test_an_index_whose_certificate_is_not_trusted(run, tmp_path):
    """pip itself ends by blaming the versions that were asked for."""
    pytest.importorskip("ensurepip", reason="this Python cannot make virtual environments")
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    both = tmp_path / "own.pem"
    make = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=own -addext subjectAltName=DNS:localhost"
    subprocess.run([*make.split(), "-keyout", both, "-out", tmp_path / "c.pem"], check=True, capture_output=True)
    both.write_text(both.read_text() + (tmp_path / "c.pem").read_text())
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(both)
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        index = {"PIP_INDEX_URL": f"https://localhost:{server.server_address[1]}/simple", "PIP_RETRIES": "0"}
        sentence = refusal(run("setup", programs={"python3": this_python()}, **index))
        server.shutdown()
    assert "certificate of the package index is not trusted" in sentence and "export PIP_CERT=" in sentence


PROGRAMS = ("uncertain-lti", "envelope_monitor", "plant", "turbofan")
_ENVIRONMENT = r"""
import sys
from pathlib import Path

def write(path, text):
    path.write_text(f"#!{bash}\n{{text}}\n")
    path.chmod(0o755)

bin = Path(sys.argv[-1]) / "bin"
bin.mkdir(parents=True)
write(bin / "python", '[[ $2 == pip || $1 == *.whl/pip ]] || exec "{python}" "$@"')
for name in {programs}:
    write(bin / name, 'printf "%s\\n" "${{0##*/}}" "$PWD" "$@"')
"""


def making(folder: Path, first: str = "") -> str:
    """Shell text that is this interpreter, but makes an environment by `_ENVIRONMENT`, after what is to come first."""
    python, maker = Path(sys.executable).resolve(), folder / "make_environment.py"
    maker.write_text(first + _ENVIRONMENT.format(bash=folder / "bin" / "bash", python=python, programs=PROGRAMS))
    return f'[[ "$1 $2" == "-m venv" ]] && exec "{python}" "{maker}" "$@"\n{this_python()}'


@pytest.fixture
def elsewhere(run, tmp_path):
    """Call `./run` from another folder; its environment has programs that print name, folder and arguments."""
    python3 = making(tmp_path)
    folder = tmp_path / "some where"
    folder.mkdir()

    def call(*arguments: str, **environment: str):
        done = run(*arguments, programs={"python3": python3}, cwd=folder, **environment)
        assert done.returncode == 0, done
        lines = done.stdout.strip().splitlines()
        return lines[next(i for i, line in enumerate(lines + [""]) if line and not line.startswith("./run:")) :]

    return call


@pytest.mark.parametrize("program", PROGRAMS)
def test_programs_run_in_the_folder_of_the_caller(elsewhere, tmp_path, program):
    arguments = ["fit", "a bag.mcap", "--output", "../x.model.json"]
    for _ in range(2):  # the first time installs, the second does not
        assert elsewhere(program, *arguments) == [program, str(tmp_path / "some where"), *arguments]


def test_programs_hear_this_machine_alone_unless_told_otherwise(elsewhere, tmp_path):
    names = "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"
    (tmp_path / "some where" / "mine.py").write_text(f"import os; print(*map(os.getenv, {names}))")
    domain, reach = elsewhere("python", "mine.py")[0].split()
    assert 1 <= int(domain) <= 100 and reach == "LOCALHOST"
    robot = dict(zip(names, ("7", "SUBNET"), strict=True))
    assert elsewhere("python", "mine.py", **robot) == ["7 SUBNET"]


@pytest.fixture
def slow(tmp_path):
    """Shell text that is this interpreter, and takes a second to make an environment, which is noted in a file."""
    return making(tmp_path, f"import time\nopen({str(tmp_path / 'made')!r}, 'a').write('x')\ntime.sleep(1)\n")


def test_of_two_starts_at_once_one_installs_and_the_other_waits(run, slow, tmp_path):
    with ThreadPoolExecutor(2) as both:
        done = list(both.map(lambda _: run("setup", programs={"python3": slow}), range(2)))
    assert [d.returncode for d in done] == [0, 0], done
    assert (tmp_path / "made").read_text() == "x"
    assert sum("another ./run is installing" in d.stdout for d in done) == 1
    assert all("ready: .venv" in d.stdout for d in done)


def test_a_start_from_the_environment_itself_does_not_make_it_again(run, slow, tmp_path):
    """The interpreter that made it was a link; that of .venv names what the link leads to."""
    pytest.importorskip("ensurepip", reason="this Python cannot make virtual environments")
    environment, link = tmp_path / "a checkout" / ".venv", tmp_path / "link" / "python3"
    link.parent.mkdir()
    link.symlink_to(Path(sys.executable).resolve())
    outside = slow.replace(this_python(), f'exec "{link}" "$@"')
    assert "ready" in run("setup", programs={"python3": outside}).stdout
    made_from = (environment / "made-from").read_text()
    shutil.rmtree(environment)
    subprocess.run([link, "-m", "venv", "--without-pip", environment], check=True)
    (environment / "made-from").write_text(made_from)
    (environment / "made-for").write_text("use\n")
    done = run("setup", programs={"python3": f'exec "{environment}/bin/python3" "$@"'})
    assert done.returncode == 0 and "ready" in done.stdout and "installing" not in done.stdout, done
    assert (tmp_path / "made").read_text() == "x"


def test_ctrl_c_while_installing_is_one_sentence_and_130(run, slow, tmp_path):
    (tmp_path / "bin" / "python3").write_text(f"#!{tmp_path / 'bin'}/bash\n{slow}\n")
    (tmp_path / "bin" / "python3").chmod(0o755)
    env = {"PATH": str(tmp_path / "bin"), "HOME": str(tmp_path)}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    process = subprocess.Popen([tmp_path / "a checkout" / "run", "setup"], env=env, **options)
    deadline = time.monotonic() + 300
    while not (tmp_path / "made").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130, said
    assert said.strip() == "./run: interrupted; .venv is not whole, and the next start makes it again."
    assert run("setup", programs={"python3": slow}).returncode == 0 and (tmp_path / "made").read_text() == "xx"


@pytest.mark.skipif(os.geteuid() != 0, reason="it takes root to be somebody else")
def test_a_checkout_of_somebody_else_is_a_sentence(run, tmp_path):
    folder = Path(subprocess.check_output(["mktemp", "-d"], text=True).strip())
    try:
        shutil.copytree(tmp_path / "a checkout", folder, dirs_exist_ok=True)
        folder.chmod(0o755)
        env = {"PATH": f"{Path(sys.executable).resolve().parent}:/usr/bin:/bin", "HOME": "/"}
        done = subprocess.run([folder / "run", "setup"], env=env, user=65534, capture_output=True, text=True)
    finally:
        shutil.rmtree(folder)
    if "Python 3.11, 3.12 or 3.13 is needed" in done.stderr:
        pytest.skip("others cannot run this Python")
    assert "/.venv cannot be written by" in refusal(done) and "copy the checkout" in done.stderr


@pytest.mark.parametrize("command", ["demo", "envelope_monitor", "turbofan"])
def test_a_machine_without_loopback_is_a_sentence(run, tmp_path, command):
    unshare = shutil.which("unshare")
    if not unshare or subprocess.run([unshare, "-rn", "true"], capture_output=True).returncode:
        pytest.skip("this user cannot be without a network")
    env = {"PATH": f"{Path(sys.executable).resolve().parent}:{os.environ['PATH']}"}
    line = [unshare, "-rn", tmp_path / "a checkout" / "run", command]
    done = subprocess.run(line, capture_output=True, text=True, env=env)
    assert "the loopback interface of this machine is down" in refusal(done) and "ip link set lo up" in done.stderr


def noting(maker: Path, asked: Path) -> None:
    """Let the environments that are made note what their pip is asked for."""
    said = "[[ $2 == pip || $1 == *.whl/pip ]]"
    maker.write_text(maker.read_text().replace(said, f'{said} && printf "%s\\\\n" "$*" >>"{asked}"; {said}'))


def test_the_programs_need_less_than_the_tests(run, slow, tmp_path):
    """What is asked for later is added to what there is; what is there is not installed again."""
    asked = tmp_path / "asked"
    noting(tmp_path / "make_environment.py", asked)
    for option in ([], [], ["--all"], []):
        assert run("setup", *option, programs={"python3": slow}).returncode == 0
    first, second = (line.rpartition(" ")[2] for line in asked.read_text().splitlines() if " -e " in line)
    assert first == ".[completion,fast,fit,plots,ros]"
    assert set(second[2:-1].split(",")) > {"completion", "fit", "plots", "ros", "test", "docs", "oracle", "tables"}
    assert (tmp_path / "made").read_text() == "x"


def test_a_small_environment_for_robots_that_only_monitor(run, slow, tmp_path):
    """Neither the recordings' nor the fit's packages: what is asked for is numpy, PyYAML, rclpy, and this alone."""
    asked = tmp_path / "asked"
    noting(tmp_path / "make_environment.py", asked)
    done = run("setup", "--monitor", programs={"python3": slow})
    assert done.returncode == 0 and "ready: .venv-monitor" in done.stdout, done
    first, second = (line for line in asked.read_text().splitlines() if "--no-build-isolation" in line)
    wanted = first.partition("--no-build-isolation ")[2].split()
    assert wanted[:2] == ["numpy", "PyYAML"] and [w.partition("==")[0] for w in wanted[2:]] == [
        "ros-jazzy-common-interfaces",
        "ros-rclpy[fastrtps]",
    ]
    assert second.endswith("--no-deps -e .") and not (tmp_path / "a checkout/.venv").exists()
