"""Figures of a run: plain functions from records and counts to a Matplotlib `Figure`.

Nothing here reads a run folder (that is `palm_jax.train.report`), and nothing touches Matplotlib's
global state: figures are `matplotlib.figure.Figure` objects drawn by the Agg back end, so they work
without a display and in any thread. Colours come from the Okabe-Ito palette and from cividis, both
readable with any colour vision; no figure relies on colour alone.

Maps of the table are drawn as the front camera sees it: world y to the right, world x downwards,
the robot at the top. Angles are radians in arguments and degrees on axes. Every interval is a
Wilson 95 % interval.
"""

from palm_jax.train.reporting.figures.bars import domain_bars
from palm_jax.train.reporting.figures.curves import angle_curves, strength_curves, training_curves
from palm_jax.train.reporting.figures.galleries import gallery, picture_grid
from palm_jax.train.reporting.figures.maps import heatmaps, sample_distribution
from palm_jax.train.reporting.figures.style import BAD, GOOD, ImageArray, Look, look, save

__all__ = [
    "BAD",
    "GOOD",
    "ImageArray",
    "Look",
    "angle_curves",
    "domain_bars",
    "gallery",
    "heatmaps",
    "look",
    "picture_grid",
    "sample_distribution",
    "save",
    "strength_curves",
    "training_curves",
]
