"""Mitsuba 3 scenes as JAX functions, by black box."""

from smoothdiff.renderers._mitsuba_levels import levels
from smoothdiff.renderers._mitsuba_renderer import Renderer, renderer
from smoothdiff.renderers._mitsuba_scene import available

__all__ = ["Renderer", "available", "levels", "renderer"]
