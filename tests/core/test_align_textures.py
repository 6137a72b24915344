"""Procedural backgrounds."""

import jax
import numpy as np
import pytest

from palm_jax.align import OptionError, procedural_bank


def test_bank_is_varied_and_reproducible():
    bank = np.asarray(procedural_bank(jax.random.key(0), 96, 24))
    assert bank.shape == (96, 24, 24, 3) and bank.dtype == np.uint8
    np.testing.assert_array_equal(bank, procedural_bank(jax.random.key(0), 96, 24))
    assert (bank != np.asarray(procedural_bank(jax.random.key(1), 96, 24))).any((1, 2, 3)).all()
    values = bank.astype(float)
    assert len({image.tobytes() for image in bank}) == 96
    # No image is flat, the colours fill the cube, and textures are smooth as well as rough.
    assert values.std((1, 2)).max(-1).min() > 2
    assert values.mean((1, 2)).min() < 60 and values.mean((1, 2)).max() > 190
    roughness = np.abs(np.diff(values, axis=2)).mean((1, 2, 3))
    assert roughness.min() < 3 and roughness.max() > 20


def test_every_family_takes_part():
    # Sixteen of each, in order; their roughness tells bands from gradients.
    bank = np.asarray(procedural_bank(jax.random.key(0), 96, 24)).astype(float)
    rough = np.abs(np.diff(bank, axis=2)).mean((1, 2, 3)).reshape(6, 16).mean(1)
    assert rough[3] < 0.5 * rough[[0, 1, 2, 4, 5]].min()


@pytest.mark.parametrize("count", [1, 7])
def test_small_banks(count):
    assert procedural_bank(jax.random.key(0), count, 8).shape == (count, 8, 8, 3)


def test_bad_sizes():
    with pytest.raises(OptionError, match="at least 1"):
        procedural_bank(jax.random.key(0), 0, 8)
