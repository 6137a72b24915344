"""Data that this package did not record: read, calibrate, check, align, repair.

For training on a user's own file::

    from palm_jax.train import data

    with data.open_recording(path, calibration_path) as recording:
        data.preflight(recording)  # raises what is wrong before an image is read
        spec = data.paper_spec(recording.camera.height)
        for episode in data.aligned_episodes(recording, spec):
            episode.images, episode.proprio, episode.actions  # [T, ...], NumPy

Formats: robomimic HDF5, and LeRobot v3 with the extra `lerobot`.
"""

from palm_jax.train.data.aligning import (
    AlignedEpisode,
    align_frames,
    aligned_episodes,
    labels,
    paper_spec,
    stream,
)
from palm_jax.train.data.calibration import Calibration, CameraCalibration, RobotKeys
from palm_jax.train.data.calibration import load as load_calibration
from palm_jax.train.data.calibration import save as save_calibration
from palm_jax.train.data.errors import DataError
from palm_jax.train.data.job import Options, align_file, preflight
from palm_jax.train.data.recording import Recording, Trajectory, open_recording
from palm_jax.train.data.soundness import repair, verify
from palm_jax.train.data.source import Source, open_source

__all__ = [
    "AlignedEpisode",
    "Calibration",
    "CameraCalibration",
    "DataError",
    "Options",
    "Recording",
    "RobotKeys",
    "Source",
    "Trajectory",
    "align_file",
    "align_frames",
    "aligned_episodes",
    "labels",
    "load_calibration",
    "open_recording",
    "open_source",
    "paper_spec",
    "preflight",
    "repair",
    "save_calibration",
    "stream",
    "verify",
]
