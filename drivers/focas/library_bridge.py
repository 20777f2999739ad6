"""Loads FANUC's FOCAS2 library and answers one JSON line with one JSON line, as a program that the driver starts.

Nothing here may import from Toolpoint. First line in: `{library, host, port, path, timeout_s}`. Then requests with an
`id`, which the answer repeats: `asks`, blocks of (function, arguments, further bytes) as they go over the wire; their
answers are (error, bytes) as a control sends them. Signatures and structures are those of the published fwlib32.h,
packed to four bytes, whose `long` has four bytes. It ends when its input ends or when the library says that the link
is lost.
"""

import ctypes
import json
import os
import struct
import sys
from typing import Any

SYSTEM, STATUS, PROGRAM, SEQUENCE, SPEED, READ_MACRO, WRITE_MACRO = 0x18, 0x19, 0x1C, 0x1D, 0x25, 0x15, 0x16
BUSY, NO_FUNCTION, NOT_THIS_VALUE = -1, 1, 5
ONE_MACRO = 10
"""Length that the library wants to be told of one macro variable [byte]."""
HEAD, EACH = 8, 8
"""The same of several: of what stands before them, and of each."""
LARGEST = 999_999_999
VALUE = struct.Struct(">iHh")
NEEDED = (
    "cnc_allclibhndl3",
    "cnc_freelibhndl",
    "cnc_sysinfo",
    "cnc_statinfo",
    "cnc_rdprgnum",
    "cnc_rdseqnum",
    "cnc_acts",
    "cnc_rdmacror",
    "cnc_wrmacro",
)


class LostError(Exception):
    """The library has no link any more; the text says why."""


class Library:
    """One session of the library."""

    def __init__(self, first: dict[str, Any]) -> None:
        self.library = ctypes.CDLL(first["library"])
        for name in NEEDED:
            getattr(self.library, name).restype = ctypes.c_short
        self.handle = ctypes.c_ushort()
        if hasattr(self.library, "cnc_startupprocess"):  # on Linux
            self.library.cnc_startupprocess(ctypes.c_int32(0), b"/dev/null")
        host, port = first["host"].encode(), ctypes.c_ushort(first["port"])
        timeout_s = ctypes.c_long(max(1, round(first["timeout_s"])))
        self.done(self.library.cnc_allclibhndl3(host, port, timeout_s, ctypes.byref(self.handle)), "cnc_allclibhndl3")
        if first["path"] != 1:
            self.done(self.library.cnc_setpath(self.handle, ctypes.c_short(first["path"])), "cnc_setpath")

    def done(self, code: int, name: str) -> None:
        """Raise LostError unless a call was done."""
        if code != 0:
            raise LostError(f"{name} of FANUC's library says error {code}")

    def called(self, name: str, *arguments: Any) -> int:
        """Call a function; return what the control says, 0: done. Raises LostError for what the library says."""
        code = int(getattr(self.library, name)(self.handle, *arguments))
        if code < BUSY:
            self.done(code, name)
        return code

    def filled(self, name: str, size: int, *arguments: Any) -> tuple[int, bytes]:
        """Call a function that fills a structure of so many bytes."""
        place = ctypes.create_string_buffer(size)
        return self.called(name, *arguments, ctypes.byref(place)), place.raw

    def answer(self, function: int, arguments: list[int], extra: bytes) -> tuple[int, bytes]:
        """Return the answer to one block as a control sends it."""
        if function == SYSTEM:
            return self.filled("cnc_sysinfo", 18)
        if function == STATUS:
            code, found = self.filled("cnc_statinfo", 18)
            _, _, mode, run, motion, mstb, emergency, alarm, edit = struct.unpack("=9h", found)
            return code, struct.pack(">7h", mode, run, motion, mstb, emergency, alarm, edit)
        if function == PROGRAM:
            code, found = self.filled("cnc_rdprgnum", 12)
            running, main = struct.unpack_from("=2i" if any(found[8:]) else "=2h", found, 4)
            return code, struct.pack(">2i", running, main)
        if function in (SEQUENCE, SPEED):
            code, found = self.filled("cnc_rdseqnum" if function == SEQUENCE else "cnc_acts", 8)
            (number,) = struct.unpack_from("=i", found, 4)
            return code, struct.pack(">i", number) if function == SEQUENCE else VALUE.pack(number, 10, 0)
        if function == READ_MACRO:
            return self.macros(arguments[0], arguments[1])
        if function == WRITE_MACRO:
            mantissa, _, decimals = VALUE.unpack(extra)
            while abs(mantissa) > LARGEST and decimals > 0:
                mantissa, decimals = round(mantissa / 10), decimals - 1
            if abs(mantissa) > LARGEST:
                return NOT_THIS_VALUE, b""
            number, length = ctypes.c_short(arguments[0]), ctypes.c_short(ONE_MACRO)
            value = ctypes.c_int32(mantissa), ctypes.c_short(decimals)
            return self.called("cnc_wrmacro", number, length, *value), b""
        return NO_FUNCTION, b""

    def macros(self, first: int, last: int) -> tuple[int, bytes]:
        """Return macro variables as a control sends them; a negative number of decimals is a vacant one."""
        count = last - first + 1
        size = HEAD + EACH * count
        numbers = ctypes.c_short(first), ctypes.c_short(last), ctypes.c_short(size)
        code, found = self.filled("cnc_rdmacror", size, *numbers)
        if code != 0:
            return code, b""
        values = [struct.unpack_from("=ih", found, HEAD + EACH * place) for place in range(count)]
        return 0, b"".join(VALUE.pack(mantissa, 10, decimals if decimals >= 0 else -1) for mantissa, decimals in values)

    def end(self) -> None:
        """Give the session back."""
        self.library.cnc_freelibhndl(self.handle)


def first_answer(first: dict[str, Any]) -> tuple[Library | None, dict[str, Any]]:
    """Load the library and open a session."""
    try:
        return Library(first), {}
    except OSError as error:
        return None, {"fatal": f"cannot be loaded: {error}"}
    except AttributeError as error:
        return None, {"fatal": f"is no FOCAS2 library: {error}"}


def main() -> int:
    """Answer until the input ends."""
    library = None
    talk = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print where they like
    try:
        for line in sys.stdin:
            request = json.loads(line)
            try:
                if library is None:
                    library, answer = first_answer(request)
                else:
                    found = [library.answer(kind, words, bytes.fromhex(more)) for kind, words, more in request["asks"]]
                    answer = {"answers": [[code, data.hex()] for code, data in found]}
            except LostError as error:
                answer = {"error": str(error)}
            talk.write(json.dumps({"id": request["id"], **answer}) + "\n")
            talk.flush()
            if "error" in answer or "fatal" in answer:
                return 1
    finally:
        if library is not None:
            library.end()
    return 0


if __name__ == "__main__":
    sys.exit(main())
