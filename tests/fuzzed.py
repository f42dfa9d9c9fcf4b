"""How many random calls are made, and what is asked of an error. No tests here."""

import os
from typing import Any

import smoothdiff as sd

CALLS = int(os.environ.get("FUZZ_CALLS", 200))
# a call of a made-up solver run is dear, a cast or a refusal is cheap
CASTS, REFUSALS, TRANSFORMS, RUNS = (round(CALLS * share) for share in (0.5, 0.3, 0.175, 0.025))
REFUSAL = TypeError, ValueError, sd.BlackBoxError, sd.MinimiseError


def outcome(call) -> tuple[Any, Any]:
    """What it returns, or what it raises."""
    try:
        return call(), None
    except Exception as error:
        return None, error


def says_what_to_write(message):
    return any(
        word in message.lower() for word in ("write ", "give ", "allow ", "must ", "use ", "needs ")
    )
