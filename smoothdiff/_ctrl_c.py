"""Ctrl-C during a run ends it, wherever it comes."""

import contextlib
import signal
import socket
import threading
from collections.abc import Iterator

# a socket of each `ctrl_c_noticed` block that is open, the innermost last
_open: list[socket.socket] = []


@contextlib.contextmanager
def ctrl_c_noticed() -> Iterator[None]:
    """Inside, `raise_if_pressed` raises KeyboardInterrupt once Ctrl-C came.

    Python does so in the main thread, when that runs Python next; not in a thread of JAX's, which
    evaluates the rest of a batch. In a hook of JAX's the exception is dropped, or becomes another
    one. So the signal itself is looked for, of which the operating system tells a socket at once;
    but not in other threads, nor where Ctrl-C means something else.
    """
    alone = threading.current_thread() is threading.main_thread()
    if not alone or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    told, end = socket.socketpair()
    with told, end:
        told.setblocking(False)
        end.setblocking(False)
        before = signal.set_wakeup_fd(end.fileno(), warn_on_full_buffer=False)
        _open.append(told)
        try:
            yield
        finally:
            _open.remove(told)
            signal.set_wakeup_fd(before)


def raise_if_pressed() -> None:
    """Raises KeyboardInterrupt where Ctrl-C came, in whatever thread this is."""
    if _pressed():
        raise KeyboardInterrupt


def is_ctrl_c(error: BaseException) -> bool:
    """Whether an exception is that of Ctrl-C, or follows from it."""
    return isinstance(error, KeyboardInterrupt) or _pressed()


def _pressed() -> bool:
    with contextlib.suppress(IndexError, BlockingIOError):  # no block is open, nothing came
        return signal.SIGINT in _open[-1].recv(65536, socket.MSG_PEEK)
    return False
