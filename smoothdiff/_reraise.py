"""What a callback raises arrives as itself where its result is awaited."""

import contextlib
from collections.abc import Iterator

import jax

# What has been raised in a callback since each of the `reraise` blocks now open was entered.
_open_blocks: dict[int, list[BaseException]] = {}


@contextlib.contextmanager
def reraise() -> Iterator[None]:
    """Inside, what a black box raises arrives as itself: BlackBoxError with its cause, Ctrl-C.

    Of every exception in a callback, even KeyboardInterrupt, JAX keeps only the text: it raises a
    JaxRuntimeError or, from the second call of a jitted function on, a ValueError. By that text the
    original is found again. It has to be put aside where this block and the callback, which may run
    in a thread of JAX's, both see it, hence in the module; but only while a block is open. Results
    must be awaited inside (`jax.block_until_ready`).
    """
    raised: list[BaseException] = []
    _open_blocks[id(raised)] = raised
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as failure:
        text = str(failure)
        for error in reversed(raised):
            if type(error).__name__ in text and _clean(error) in text:
                raise error.with_traceback(None) from error.__cause__
        raise
    finally:
        del _open_blocks[id(raised)]


def was_raised(error: BaseException) -> BaseException:
    """Puts aside what a callback raises, and gives what to raise so that JAX can have its text."""
    for raised in list(_open_blocks.values()):
        raised.append(error)
    text = _clean(error)
    return error if text == str(error) else RuntimeError(f"{type(error).__name__}: {text}")


def _clean(error: BaseException) -> str:
    """The text without what XLA cannot take: it crashes at a lone surrogate, and ends at a NUL."""
    text = str(error).encode(errors="backslashreplace").decode()
    return text.replace("\0", r"\x00")
