# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Metadata and layout of the package, read by pip and by colcon; tool settings are in pyproject.toml."""

import os
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Extension, find_packages, setup

NAME = "uncertain_lti_ros"
CORE = {"uncertain_lti": "core"}
CORE |= {f"uncertain_lti.{name}": f"core/{name.replace('.', '/')}" for name in find_packages("core")}
ROOT = Path(__file__).resolve().parent
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()


def share(folder: str) -> list[tuple[str, list[str]]]:
    """List the files of a folder, to be installed to share/ as they lie here."""
    by_folder: dict[str, list[str]] = {}
    for path in sorted((ROOT / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(ROOT)
            by_folder.setdefault(f"share/{NAME}/{relative.parent}", []).append(str(relative))
    return list(by_folder.items())


COMPILED = {
    "kernel.arithmetic": "-O2 -ftree-loop-vectorize",
    "monitor.envelope_monitor": "-Og",
    "monitor.intake": "-Og",
    "monitor.outputs": "-Og",
    "monitor.stream": "-Og",
    "monitor.verdict": "-Og",
    "recordings.mcap_walk": "-O1",
    "recordings.message_reader": "-O1",
    "sampling.sampler": "-O1",
}
"""Modules that are compiled, and how: the kernel, and typed Python of the live chain.

-Og takes half the time to compile that -O1 takes, and the live chain 3 % more.
"""
SHARED = "uncertain_lti.kernel.shared"
"""What every module that reads arrays needs of Cython, compiled once; before 3.1 each of them brings its own."""


def compiled() -> list[Extension]:
    """The modules in `COMPILED`, all of them required.

    Contraction of a * b + c is off, so that every machine gives the same bits.
    """
    from Cython.Build import cythonize
    from Cython.Compiler.Options import default_options

    always = ["-g0", "-w", "-ffp-contract=off"]
    options = {"build_dir": "build/cython", "language_level": 3, "quiet": True}
    extensions = []
    for dotted, level in COMPILED.items():
        path = Path("core", *dotted.split("."))
        source = next(str(path.with_suffix(end)) for end in (".pyx", ".py") if (ROOT / path).with_suffix(end).exists())
        extensions.append(Extension(f"uncertain_lti.{dotted}", [source], extra_compile_args=[*level.split(), *always]))
    if "shared_utility_qualified_name" in default_options:
        options["shared_utility_qualified_name"] = SHARED
        extensions.append(Extension(SHARED, ["core/kernel/shared.c"], extra_compile_args=["-Og", *always]))
    found: list[Extension] = cythonize(extensions, **options)
    return found


extras = {
    # What `uncertain_lti.fit` needs. The newest of these want numpy 2: in a sourced ROS 2 say
    # `pip install '.[fit]' 'numpy<2'` (./run pins its numpy), and pip takes the last that do without.
    "fit": ["daqp", "highspy", "piqp", "scipy", "threadpoolctl"],
    # `fit(method="cvxpy")`: the whole problem as written, for comparison.
    "oracle": ["cvxpy", "highspy", "osqp>=1"],
    "cluster": ["distributed"],
    # Checksums of recordings ten times as fast as zlib's.
    "fast": ["isal"],
    "frames": ["pandas"],
    # Parquet, Feather and .mat files; CSV and .npz take numpy alone.
    "tables": ["pyarrow", "scipy"],
    "completion": ["shtab"],
    # Reports and interactive plots take jinja2 alone, images matplotlib.
    "plots": ["jinja2", "markupsafe", "matplotlib"],
    # To and from python-control; MATLAB files take scipy alone.
    "control": ["control", "scipy"],
    # The pages in docs/, built by `./run docs`.
    "docs": ["furo", "latex2mathml", "myst-parser", "sphinx"],
    # Real rclpy where no ROS 2 is installed: wheels for x86_64 Linux.
    "ros": ["ros-jazzy-common-interfaces==5.3.6", "ros-rclpy[fastrtps]==7.1.6"],
    # colcon test looks for pytest here; setuptools lets the tests read this file; cyclonedds hears the node from
    # another vendor's DDS.
    "test": [
        "Cython>=3",
        "cyclonedds; platform_machine == 'x86_64'",
        "hypothesis",
        "packaging",
        "pytest",
        "pytest-timeout",
        "pytest-xdist",
        "setuptools",
    ],  # fmt: skip
    "dev": ["mypy", "ruff", "types-PyYAML"],
}

setup(
    name=NAME,
    version="0.2.0",
    description="Linear models with bounded uncertainty, fitted to recordings and watched live in ROS 2",
    maintainer=PACKAGE.findtext("maintainer"),
    maintainer_email=PACKAGE.find("maintainer").get("email"),
    url=PACKAGE.findtext("url"),
    project_urls={url.get("type"): url.text for url in PACKAGE.findall("url")[1:]},
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=[*CORE, NAME],
    package_dir=CORE,
    package_data={
        "uncertain_lti": ["py.typed"],
        "uncertain_lti.kernel": ["*.pxi", "*.pyi", "*.pyx"],
        "uncertain_lti.plants": ["*.json"],
        "uncertain_lti.recordings": ["*.pyi", "*.pyx"],
        "uncertain_lti.reports": ["assets/*"],
        "uncertain_lti.sampling": ["*.pxi", "*.pyi", "*.pyx"],
        NAME: ["*.xml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *share("bags"),
        *share("config"),
        *share("launch"),
    ],
    ext_modules=compiled(),
    options={"build_ext": {"parallel": os.cpu_count()}},
    zip_safe=False,
    install_requires=["lz4", "mcap", "numpy>=1.26", "PyYAML", "rosbags", "tqdm", "zstandard"],
    extras_require=extras,
    entry_points={
        "console_scripts": [
            "uncertain-lti = uncertain_lti.cli:begin",
            "envelope_monitor = uncertain_lti_ros.nodes:envelope_monitor",
            "plant = uncertain_lti_ros.nodes:plant",
            "turbofan = uncertain_lti_ros.nodes:turbofan",
        ]
    },
)
