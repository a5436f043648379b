from collections.abc import Callable, Mapping, Sequence
from typing import Any

from uncertain_lti.base.arrays import Array, Integers
from uncertain_lti.signals.field_path import FieldPath, TypeFields

CODES: Mapping[str, str]
"""Type -> its code in struct and in numpy."""
ENCAPSULATIONS: Sequence[bytes]
"""Plain CDR, and what the middleware reads as such; only the first is big-endian."""
NO_STAMP: int
NOT_PLAIN: int
"""State of a message of `Plan.read_all` that the recorder may have compressed."""

class UnfitError(Exception): ...
class UnreadableError(Exception): ...

class Plan:
    able: bool
    seconds: int
    def __init__(self, type_name: str, paths: Sequence[FieldPath], type_fields: TypeFields) -> None: ...
    def wrong(self, data: bytes) -> str: ...
    def in_words(self, what: int) -> str: ...
    def read(self, data: bytes) -> tuple[int, Any]: ...
    def read_all(
        self, buffer: bytes | bytearray, begin: Integers, end: Integers, values: Array, stamps: Integers
    ) -> Integers: ...

class MessageReader:
    type_name: str
    decode: Callable[[bytes], Any]
    decoded: int
    strange: bool
    def __init__(
        self,
        type_name: str,
        paths: Sequence[FieldPath],
        type_fields: TypeFields,
        decode: Callable[[bytes], Any],
        largest: int = ...,
    ) -> None: ...
    def read(self, data: bytes) -> tuple[int | None, Sequence[float]]: ...

def header_stamp_ns(message: Any) -> int | None: ...
