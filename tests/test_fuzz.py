"""Damage gives a clear error or a correct reading; `python tests/fuzz.py` tries ten thousand files and messages."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import fuzz
import pytest


@pytest.mark.parametrize("kind", list(fuzz.KINDS))
def test_damage_gives_a_clear_error_or_a_correct_reading(kind: str) -> None:
    if kind == "messages":
        pytest.importorskip("rclpy", reason="rclpy, whose reading layouts are held against, is not installed")
    outcome = fuzz.run(kind, first=20_000, count=150)
    assert not outcome.failures, "\n".join(outcome.failures)
    assert sum(outcome.counts.values()) == 150
    assert outcome.counts["read"] > 30 and outcome.counts["refused"] > 5, "the damage is too small or too great"


def test_whatever_goes_wrong_is_noticed(tmp_path: Path) -> None:
    """The harness itself, on cases that do what no case may do."""
    program = tmp_path / "wrong.py"
    program.write_text("""
import os, time, fuzz
fuzz.LIMIT_S = 0.5
def wrong(rng, folder):
    kind = next(kinds)
    if kind == "raise":
        raise KeyError("nobody raised this on purpose")
    if kind == "die":
        os._exit(3)
    if kind == "hang":
        time.sleep(60)
    if kind == "ask for much":
        bytearray(fuzz.LIMIT_MEMORY + 1)
    return "read"
kinds = iter(())
fuzz.KINDS["wrong"] = wrong
if __name__ == "__main__":
    import sys
    seed = int(sys.argv[sys.argv.index("--seed") + 1])
    kinds = iter(["fine", *["raise", "ask for much", "fine", "hang", "die", "fine"][seed:]])
    raise SystemExit(fuzz.main())
""")
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        outcome = fuzz.run("wrong", first=0, count=6, program=str(program))
    assert outcome.counts == {"read": 2}
    for failure, (seed, why) in zip(
        outcome.failures, [(0, "KeyError"), (1, "MemoryError"), (3, "Timeout"), (4, "ended with 3")], strict=True
    ):
        assert f"--seed {seed}:" in failure and why in failure
