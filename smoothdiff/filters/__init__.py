"""Filters of gradients in space, on grids and on meshes: `filter(signal, guide) -> signal`.

The guide says where to smooth. The transformations of optax that use a filter, such as
`smoothdiff.filtered_adam`, give it the parameters as guide.
"""

from smoothdiff.filters.grid import bilateral, cross_bilateral, laplacian
from smoothdiff.filters.mesh import mesh_bilateral, mesh_laplacian

__all__ = ["bilateral", "cross_bilateral", "laplacian", "mesh_bilateral", "mesh_laplacian"]
