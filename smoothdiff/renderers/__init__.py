"""Renderers as JAX functions; each module is imported only by who asks for it."""
