"""PALM, perception alignment for local visuomotor policies, in JAX.

Layers, each importing only those to its right::

    palm_jax.train  ->  palm_jax.envs  ->  palm_jax.render, palm_jax.align  ->  jax

`palm_jax.align` is what most users want: crop, overlay and proprioception for their own images.
Importing this package loads nothing heavy; import the submodule that you need.
"""

__version__ = "0.1.0"
