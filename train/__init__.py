"""Demonstrations, learner, evaluation and reports: the layer with files, clocks and printing."""

if __name__ != "palm_jax.train":
    raise ImportError(
        "import this package as `palm_jax.train`, not as `train`: a second copy under another name "
        "would have its own, incompatible classes (`palm_jax/train` is a link to `train/`)."
    )
