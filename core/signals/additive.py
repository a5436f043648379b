"""Choices of `additive`, which names the additive terms of a fit: in Python, signals files and on the command line."""

from __future__ import annotations

from typing import Literal, get_args

Additive = Literal["none", "disturbance", "noise", "both"]
CHOICES: tuple[Additive, ...] = get_args(Additive)
CHOICES_TEXT = f"{', '.join(CHOICES[:-1])} or {CHOICES[-1]}"
"""The choices as a part of a sentence."""
