"""How the site reads docstrings: sections by the names that we give them, fields as arguments."""

import importlib
import inspect
from typing import Any

import griffe

KINDS = {
    inspect.Parameter.POSITIONAL_ONLY: griffe.ParameterKind.positional_only,
    inspect.Parameter.POSITIONAL_OR_KEYWORD: griffe.ParameterKind.positional_or_keyword,
    inspect.Parameter.VAR_POSITIONAL: griffe.ParameterKind.var_positional,
    inspect.Parameter.KEYWORD_ONLY: griffe.ParameterKind.keyword_only,
    inspect.Parameter.VAR_KEYWORD: griffe.ParameterKind.var_keyword,
}


class Docstrings(griffe.Extension):
    """Doctests under `Example:` are code; a class that writes no `__init__` shows what it has."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Names the section of examples as griffe does."""
        if obj.docstring:
            text = obj.docstring.value
            obj.docstring.value = text.replace("\nExample:\n", "\nExamples:\n")

    def on_class(self, *, cls: griffe.Class, **_: object) -> None:
        """Gives the fields of modules and dataclasses as the arguments that they are."""
        if "__init__" in cls.members or cls.name.startswith("_"):
            return
        made = getattr(importlib.import_module(cls.module.path), cls.name, None)
        if not inspect.isclass(made):
            return
        if issubclass(made, Exception | dict) or inspect.isabstract(made):
            return
        given = [griffe.Parameter("self", kind=KINDS[inspect.Parameter.POSITIONAL_ONLY])]
        for name, parameter in inspect.signature(made).parameters.items():
            default = None if parameter.default is parameter.empty else shown(parameter.default)
            given.append(griffe.Parameter(name, kind=KINDS[parameter.kind], default=default))
        cls.set_member(
            "__init__", griffe.Function("__init__", parameters=griffe.Parameters(*given))
        )


def shown(default: Any) -> str:
    """A default value as one would write it."""
    text = getattr(default, "__name__", None) or repr(default)
    return text if len(text) < 40 else "..."
