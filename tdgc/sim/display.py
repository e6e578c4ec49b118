"""Whether a simulator can open its window."""

import ctypes
import os
import sys

from tdgc.errors import InputError


class WindowError(InputError):
    """A simulator's window cannot be opened or was closed; the message is one line."""


def check_display() -> None:
    """Check for a display, because Bullet ends the whole process without one.

    Raises:
        WindowError: no display, or no libX11 to reach it.
    """
    if sys.platform != "linux":
        return  # other systems always have one
    name = os.environ.get("DISPLAY", "")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise WindowError("a window needs X11, and libX11.so.6 is not installed") from error
    x11.XOpenDisplay.argtypes, x11.XOpenDisplay.restype = [ctypes.c_char_p], ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    display = x11.XOpenDisplay(None) if name else None
    if not display:
        raise WindowError(f"a window needs a display; DISPLAY='{name}' is none")
    x11.XCloseDisplay(display)
