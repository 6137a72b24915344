"""Video frames and files, read back with independent decoders."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from palm_jax.train.reporting import videos


def ramp(height: int, width: int, shift: int = 0) -> np.ndarray:
    """A smooth picture, so that lossy coding stays close."""
    y, x = np.mgrid[:height, :width]
    return np.stack([255 * y / height, 255 * x / width, 0 * x + 80 + shift], -1).astype(np.uint8)


def frame(**options: object) -> np.ndarray:
    settings: dict[str, object] = dict(method="palm", domain="WV", step=3, steps=9, height=24)
    return videos.compose_frame(ramp(6, 6), ramp(24, 36), **{**settings, **options})  # type: ignore[arg-type]


def test_frame_holds_both_pictures_unsmoothed() -> None:
    picture = frame()
    assert picture.dtype == np.uint8 and picture.shape[0] % 2 == 0 and picture.shape[1] % 2 == 0
    enlarged = np.kron(ramp(6, 6), np.ones((4, 4, 1), np.uint8))
    np.testing.assert_array_equal(picture[:24, :24], enlarged)
    np.testing.assert_array_equal(picture[:24, 30:66], ramp(24, 36))


def test_odd_sizes_become_even() -> None:
    picture = videos.compose_frame(
        ramp(5, 5), ramp(25, 25), method="bc", domain="ID", step=1, height=25
    )
    assert picture.shape[0] % 2 == 0 and picture.shape[1] % 2 == 0
    np.testing.assert_array_equal(picture[:25, 31:56], ramp(25, 25))


def test_caption_shows_method_and_outcome() -> None:
    running, won, lost = frame(), frame(success=True), frame(success=False)
    assert (running[-6:, 0] == [0x00, 0x72, 0xB2]).all(), "PALM's colour on the left"
    assert (won[25, 20] == [0x5C, 0xC8, 0xFF]).all()
    assert (lost[25, 20] == [0xFF, 0x9A, 0x5C]).all()
    assert (running[28:] != frame(step=4)[28:]).any(), "the step is written"
    assert (running[28:] != frame(domain="V")[28:]).any(), "the domain is written"


@pytest.mark.parametrize("bad", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8)])
def test_wrong_pictures_are_named(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="policy_input: expected uint8"):
        videos.compose_frame(bad, ramp(4, 4), method="bc", domain="ID", step=1)


def test_episode_stays_on_its_outcome() -> None:
    inputs, fulls = [ramp(6, 6, i) for i in range(5)], [ramp(24, 24, i) for i in range(5)]
    clip = videos.episode_frames(
        inputs, fulls, method="palm", domain="V", success=True, height=24, hold=3
    )
    assert len(clip) == 8
    assert all((later == clip[4]).all() for later in clip[5:])
    tint = [0x5C, 0xC8, 0xFF]
    assert [bool((f[25, 20] == tint).all()) for f in clip] == [False] * 4 + [True] * 4
    with pytest.raises(ValueError, match="5 and 4"):
        videos.episode_frames(inputs, fulls[:4], method="palm", domain="V", success=True)


def test_side_by_side_waits_for_the_longer() -> None:
    short, long = [ramp(8, 8, i) for i in (0, 50)], [ramp(8, 8, i) for i in (100, 110, 120)]
    sheets = list(videos.side_by_side([short, long], gap=2))
    assert len(sheets) == 3 and sheets[0].shape == (8, 18, 3)
    np.testing.assert_array_equal(sheets[2][:, :8], short[1])
    np.testing.assert_array_equal(sheets[2][:, 10:], long[2])
    with pytest.raises(ValueError, match="no empty one"):
        list(videos.side_by_side([short, []]))


def test_mp4_is_what_browsers_play(tmp_path: Path) -> None:
    frames = [ramp(51, 65, 4 * i) for i in range(10)]
    path = videos.write_video(tmp_path / "videos" / "a.mp4", iter(frames), fps=20)
    assert path.name == "a.mp4" and [p.name for p in path.parent.iterdir()] == ["a.mp4"]
    reader = imageio.get_reader(path, format="FFMPEG")
    about = reader.get_meta_data()
    decoded = [np.asarray(frame) for frame in reader]
    reader.close()
    assert about["codec"] == "h264" and about["pix_fmt"].startswith("yuv420p")
    assert about["fps"] == 20 and about["size"] == (64, 50)
    assert len(decoded) == 10
    for one, other in zip(frames, decoded, strict=True):
        assert np.abs(one[:50, :64].astype(int) - other).mean() < 5
    # Playable while it loads: the index comes before the data.
    content = path.read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_without_ffmpeg_a_gif(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(videos, "has_ffmpeg", lambda: False)
    frames = [ramp(20, 30, 6 * i) for i in range(10)]
    with pytest.warns(UserWarning, match="writing a GIF"):
        path = videos.write_video(tmp_path / "a.mp4", frames, fps=20)
    assert path == tmp_path / "a.gif"
    with Image.open(path) as gif:
        assert (gif.format, gif.size, gif.n_frames) == ("GIF", (15, 10), 5)  # type: ignore[attr-defined]
        assert gif.info["duration"] == 100
