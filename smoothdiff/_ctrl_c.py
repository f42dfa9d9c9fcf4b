"""Ctrl-C during a run ends it, wherever it comes."""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Iterator


class _Watch:
    """Whether Ctrl-C came while runs were under way, the innermost last.

    The operating system writes the number of each signal to a socket at once. It stays open, as a
    signal that comes while a block ends must not be written elsewhere.
    """

    def __init__(self):
        self.pressed: list[bool] = []
        self._ends: tuple[socket.socket, socket.socket] | None = None
        # who is told of signals otherwise, such as a loop of asyncio's
        self._other = -1
        # a thread of JAX's reads as well
        self._lock = threading.Lock()

    def begin(self) -> int:
        """Is told of signals from now on; who was before."""
        if self._ends is None:
            self._ends = socket.socketpair()
            for end in self._ends:
                end.setblocking(False)
        ours = self._ends[1].fileno()
        before = signal.set_wakeup_fd(ours, warn_on_full_buffer=False)
        if before != ours:
            self._other = before
        return before

    def end(self, before: int) -> None:
        """Others are told of signals again, as before."""
        signal.set_wakeup_fd(before)
        self.read()

    def read(self) -> bool:
        """Whether Ctrl-C came during the innermost run."""
        with self._lock, contextlib.suppress(BlockingIOError):  # nothing came
            while self._ends is not None and (came := self._ends[0].recv(4096)):
                if self.pressed:
                    self.pressed[-1] |= signal.SIGINT in came
                if self._other >= 0:
                    with contextlib.suppress(OSError):  # closed, or full
                        os.write(self._other, came)
        return bool(self.pressed) and self.pressed[-1]

    def forget(self) -> None:
        """A process that was forked has signals of its own."""
        if self.pressed:
            signal.set_wakeup_fd(-1)
        self.__init__()


class _Thread(threading.local):
    """How many evaluations are under way in this thread, one within the other."""

    evaluations = 0


_thread = _Thread()
_watch = _Watch()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_watch.forget)


@contextlib.contextmanager
def ctrl_c_noticed() -> Iterator[None]:
    """Inside, `raise_if_pressed` raises KeyboardInterrupt once Ctrl-C came.

    Python does so in the main thread, when that runs Python next; not in a thread of JAX's, which
    evaluates the rest of a batch. In a hook of JAX's the exception is dropped, or becomes another
    one. So the signal itself is looked for; but not in other threads, nor where Ctrl-C means
    something else.

    A run may be part of an evaluation of another run. Then it raises KeyboardInterrupt in place of
    what it found, as that other run must not take it for a value.
    """
    alone = threading.current_thread() is threading.main_thread()
    if not alone or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        if _thread.evaluations:
            raise_if_pressed()
        return
    before, outer = None, len(_watch.pressed)
    try:
        _watch.pressed.append(False)
        before = _watch.begin()
        yield
    finally:
        if before is not None:
            _watch.end(before)
        pressed = any(_watch.pressed[outer:])
        del _watch.pressed[outer:]
        if outer:
            _watch.pressed[-1] |= pressed
    raise_if_pressed()


@contextlib.contextmanager
def evaluating() -> Iterator[None]:
    """Runs inside are part of an evaluation."""
    _thread.evaluations += 1
    try:
        yield
    finally:
        _thread.evaluations -= 1


def raise_if_pressed() -> None:
    """Raises KeyboardInterrupt where Ctrl-C came, in whatever thread this is."""
    if _watch.read():
        raise KeyboardInterrupt


def is_ctrl_c(error: BaseException) -> bool:
    """Whether an exception is that of Ctrl-C, or follows from it."""
    return isinstance(error, KeyboardInterrupt) or _watch.read()
