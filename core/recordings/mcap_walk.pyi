from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Integers

class Records(NamedTuple):
    """Records of a block.

    `channel`, `log_time` (ns), `begin`, `end` (messages,): of each message, whose data is block[begin:end];
    `definitions`: opcode, begin and end of the content of every schema and channel; `short`: messages too short to be
    one; `late`: messages past 2**63 ns, which are left out; `nested`: chunks; `number`: records; `stop`: their end.
    """

    channel: NDArray[np.uint16]
    log_time: NDArray[np.uint64]
    begin: Integers
    end: Integers
    definitions: list[tuple[int, int, int]]
    short: int
    late: int
    nested: int
    number: int
    stop: int

def walk_records(
    block: bytes | bytearray | memoryview, begin: int, end: int, most: int, bare: bool = False
) -> Records: ...
