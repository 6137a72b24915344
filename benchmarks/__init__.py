"""Speed of every part, beside peers where they are installed: `python -m palm_jax bench`."""
