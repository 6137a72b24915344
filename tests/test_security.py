"""Files of strangers: they run nothing, lead nowhere else, and are printed as text."""

import ast
import html.parser
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import datasets
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import EpsImagePlugin, Image

from palm_jax.__main__ import main
from palm_jax.train import checkpoint, demos, report
from palm_jax.train import data as recordings
from palm_jax.train.checkpoint import DamagedCheckpoint
from palm_jax.train.data.errors import FormatError, TruncatedError
from palm_jax.train.data.importers import from_maniskill
from palm_jax.train.data.source import open_source
from palm_jax.train.files import pictures, records
from palm_jax.train.files import torch as torch_files
from palm_jax.train.reporting import table_page

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    path
    for folder in ("palm_jax", "envs", "train")
    for path in (ROOT / folder).rglob("*.py")
    if not (folder == "palm_jax" and {"envs", "train"} & set(path.relative_to(ROOT).parts))
)

UNPICKLERS = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal",
              "pandas", "yaml", "torch"}  # fmt: skip
"""Modules that run what a file says, or have a reader that does."""
MAY_IMPORT = {"train/files/torch.py": {"pickle"}}
RUNS = {"eval", "exec", "compile", "__import__"}
UNPACKS = {"extractall", "extract", "unpack_archive", "popen", "mktemp"}


# ------------------------------------------------------------------------------- the source itself


def dotted(node: ast.AST) -> str:
    """ "np.load" of the expression np.load; empty for what is no name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def option(call: ast.Call, name: str) -> Any:
    return next((ast.unparse(k.value) for k in call.keywords if k.arg == name), None)


def offences(source: str, allowed: set[str] = frozenset()) -> Iterator[str]:  # type: ignore[assignment]
    """What in a module could run what a file says."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module]
            yield from (
                f"import {name}"
                for name in names
                if name and name.split(".")[0] in UNPICKLERS - allowed
            )
            if isinstance(node, ast.ImportFrom) and node.module == "PIL.Image":
                yield "from PIL.Image import ..."  # whose calls would have no name to look for
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        last = name.rpartition(".")[2]
        if name in RUNS or name == "os.system" or last in UNPACKS:
            yield f"{name}(...)"
        if last in ("load", "fromfile") and name.split(".")[0] in ("np", "numpy", "jnp"):
            if option(node, "allow_pickle") != "False":
                yield f"{name} without allow_pickle=False"
        if name.startswith("pickle.") and last in ("load", "loads"):
            yield f"{name}(...)"
        if f".{name}".endswith(".Image.open") and option(node, "formats") is None:
            yield f"{name} without formats="
        if option(node, "shell") == "True":
            yield f"{name} with shell=True"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_runs_what_a_file_says(path: Path) -> None:
    allowed = MAY_IMPORT.get(str(path.relative_to(ROOT)), set())
    assert list(offences(path.read_text(), allowed)) == []


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from pickle import loads", "import torch.nn", "eval('1')", "exec(text)",
     "np.load(path)", "np.load(path, allow_pickle=True)", "numpy.load(p, allow_pickle=flag)",
     "yaml.load(x)\nimport yaml", "archive.extractall()", "os.system(x)", "run(x, shell=True)",
     "__import__(name)", "compile(text, 'f', 'exec')", "PIL.Image.open(path)", "Image.open(file)",
     "from PIL.Image import open"],
)  # fmt: skip
def test_the_search_finds_them(source: str) -> None:
    assert list(offences(source))


def test_the_search_lets_pass_what_is_safe() -> None:
    safe = (
        "re.compile(x)\nnp.load(p, allow_pickle=False)\njson.load(f)\nnp.save(p, x)\n"
        "Image.open(p, formats=FORMATS)\nfile.open()"
    )
    assert list(offences(safe)) == [] and len(SOURCES) > 60
    # The one that reads .pth files names what it knows, and calls no ready-made loader.
    assert list(offences((ROOT / "train/files/torch.py").read_text())) == ["import pickle"]


# ---------------------------------------------------------------------------------------- arrays


class Touch:
    """Pickled, this makes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


def test_arrays_of_objects_are_not_read(tmp_path: Path) -> None:
    trap = tmp_path / "trap"
    np.savez(tmp_path / "eval.npz", **{"ID/success": np.array([Touch(trap)], object)})
    with pytest.raises(records.RecordError, match="not a readable .npz file"):
        records.load_eval(tmp_path / "eval.npz")
    assert not trap.exists()


def test_an_archive_that_unpacks_to_more_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", b"\x80\x02}.")
        archive.writestr("a/data/0", bytes(10_000_000))
    with pytest.raises(ValueError, match="unpacks to more than its own size"):
        torch_files.read_tensors(tmp_path / "a.pth")


@pytest.fixture
def ghostscript(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The calls of what would run a PostScript file, instead of running it."""
    calls: list[str] = []

    def called(*_: Any, **__: Any) -> Any:
        calls.append("Ghostscript")
        return Image.new("RGB", (4, 4)).im

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", called)
    return calls


def postscript() -> bytes:
    content = io.BytesIO()
    Image.new("RGB", (4, 4)).save(content, format="EPS")
    return content.getvalue()


def test_pictures_are_of_the_kinds_that_they_say(tmp_path: Path, ghostscript: list[str]) -> None:
    """A PostScript program is none, whatever its name."""
    (tmp_path / "a.png").write_bytes(postscript())
    with Image.open(tmp_path / "a.png") as picture:
        picture.load()
    assert ghostscript.pop() == "Ghostscript"  # Pillow by itself would run it
    with pytest.raises(ValueError, match="a.png cannot be read as a picture: not a whole picture"):
        pictures.read_folder(tmp_path, 8)
    assert ghostscript == []


def test_images_in_a_table_are_of_known_kinds(tmp_path: Path, ghostscript: list[str]) -> None:
    """Those of a LeRobot data set: PNG or JPEG inside as a rule, PostScript never."""
    root = datasets.lerobot(tmp_path)
    table = root / "data/chunk-000/file-000.parquet"
    columns = pq.read_table(table)
    shown = io.BytesIO()
    Image.fromarray(datasets.frames(datasets.LIFT)[0]).save(shown, format="PNG")
    contents = [shown.getvalue(), *[postscript()] * (len(columns) - 1)]
    images = pa.array([{"bytes": content, "path": None} for content in contents])
    pq.write_table(columns.append_column("observation.images.side", images), table)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["observation.images.side"] = {"dtype": "image", "shape": [3, 128, 128]}
    (root / "meta/info.json").write_text(json.dumps(info))
    with open_source(root) as source:
        first = source.image("0", "observation.images.side", 0)
        np.testing.assert_array_equal(first, datasets.frames(datasets.LIFT)[0])
        with pytest.raises(TruncatedError, match="not a whole picture of the kinds PNG, JPEG"):
            source.image("0", "observation.images.side", 1)
    assert ghostscript == []


# ------------------------------------------------------------------------------------ checkpoints


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return checkpoint.save(tmp_path_factory.mktemp("checkpoints"), 3, {"a": np.arange(4.0)})


def forged(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """A manifest with a right checksum, by somebody who knows how."""
    content = json.loads((path / checkpoint.MANIFEST).read_text())
    change(content)
    checkpoint._write_manifest(path, content)


@pytest.mark.parametrize("name", ["../secret", "/etc/hostname", "arrays/../../secret", ""])
def test_a_manifest_names_no_file_elsewhere(name: str, saved: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(saved, tmp_path / "checkpoints" / "3"))
    forged(path, lambda content: content["files"].update({name: {"size": 0, "sha256": ""}}))
    with pytest.raises(DamagedCheckpoint, match="way-out"):
        checkpoint.verify(path)
    assert checkpoint.latest_valid(path.parent) is None
    assert (path.parent / "damaged" / "3-way-out").is_dir()


def _link_a_file(path: Path) -> None:
    file = max((p for p in (path / "arrays").rglob("*") if p.is_file()), key=lambda p: len(p.parts))
    file.rename(path.parent / "elsewhere")
    file.symlink_to(path.parent / "elsewhere")


def _link_the_arrays(path: Path) -> None:
    (path / "arrays").rename(path.parent / "elsewhere")
    (path / "arrays").symlink_to(path.parent / "elsewhere")


def _link_the_manifest(path: Path) -> None:
    (path / checkpoint.MANIFEST).rename(path.parent / "elsewhere")
    (path / checkpoint.MANIFEST).symlink_to(path.parent / "elsewhere")


def _link_all(path: Path) -> None:
    path.rename(path.parent / "elsewhere")
    path.symlink_to(path.parent / "elsewhere")


@pytest.mark.parametrize("link", [_link_a_file, _link_the_arrays, _link_the_manifest, _link_all])
def test_nothing_in_a_checkpoint_is_a_link(
    link: Callable[[Path], None], saved: Path, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(saved, tmp_path / "3"))
    link(path)
    with pytest.raises(DamagedCheckpoint, match="link"):
        checkpoint.verify(path)
    with pytest.raises(DamagedCheckpoint, match="link"):
        checkpoint.load(path, {"a": np.zeros(4)})


def test_meta_data_are_not_written_through_a_link(saved: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(saved, tmp_path / "3"))
    _link_the_manifest(path)
    before = (tmp_path / "elsewhere").read_bytes()
    with pytest.raises(DamagedCheckpoint, match="link"):
        checkpoint.update_meta(path, score=1.0)
    assert (tmp_path / "elsewhere").read_bytes() == before


# --------------------------------------------------------------------------------- demonstrations


WAYS_OUT = ["external link", "soft link", "virtual array", "outside array"]
SECRET = np.arange(15.0)


def lead_out(group: h5py.Group, name: str, kind: str, folder: Path) -> None:
    """Puts an array into a group that is not there."""
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["x"] = SECRET
    (folder / "raw").write_bytes(SECRET.tobytes())
    if kind == "external link":
        group[name] = h5py.ExternalLink(str(folder / "other.hdf5"), "/x")
    elif kind == "soft link":
        group[name] = h5py.SoftLink("/data")
    elif kind == "virtual array":
        layout = h5py.VirtualLayout(SECRET.shape, "f8")
        layout[:] = h5py.VirtualSource(folder / "other.hdf5", "x", SECRET.shape)
        group.create_virtual_dataset(name, layout)
    else:
        where = [(str(folder / "raw"), 0, SECRET.nbytes)]
        group.create_dataset(name, SECRET.shape, "f8", external=where)


@pytest.mark.parametrize("kind", WAYS_OUT)
def test_demonstrations_lie_in_their_own_file(kind: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "demos.hdf5", "w") as file:
        lead_out(file.create_group("data/demo_0"), "actions", kind, tmp_path)
    with pytest.raises(demos.DemoFileError, match="actions (is a link|lies in another file)"):
        demos.load(tmp_path / "demos.hdf5", task="lift_lid", robot="panda")


# ------------------------------------------------------------------------- recordings of others


@pytest.mark.parametrize("kind", WAYS_OUT)
@pytest.mark.parametrize("place", ["data/demo_1/obs", "mask"])
def test_recordings_lie_in_their_own_file(kind: str, place: str, tmp_path: Path) -> None:
    """Nothing of another file is read, nor copied into what `repair` writes."""

    def lead(file: h5py.File) -> None:
        lead_out(file.require_group(place), "leak", kind, tmp_path)

    path, out = datasets.changed(datasets.LIFT, tmp_path, lead), tmp_path / "out.hdf5"
    words = r"leak (is a link|lies in another file).*expand_external"
    with pytest.raises(FormatError, match=words), recordings.open_source(path) as source:
        source.numbers("demo_1", "obs/leak")
    if place == "mask":
        return
    assert "leak" in recordings.verify(path)["demo_1"][0]
    assert list(recordings.repair(path, out).dropped) == ["demo_1"]
    with h5py.File(out) as file:
        file.visititems(lambda name, item: pytest.fail(name) if "leak" in name else None)


@pytest.mark.parametrize("name", ["data", "mask", "data/demo_0"])
def test_a_file_merged_by_links_is_refused(name: str, tmp_path: Path) -> None:
    """Images that lie one after the other are read past HDF5: from this very file."""
    with h5py.File(datasets.LIFT) as old, h5py.File(tmp_path / "other.hdf5", "w") as new:
        old.copy("data", new)
        new["mask/train"] = np.array([b"demo_0"])
        for demo in new["data"].values():
            datasets.replace(demo, datasets.IMAGES, demo[datasets.IMAGES][()])
    with h5py.File(tmp_path / "merged.hdf5", "w") as merged:
        merged["pad"] = np.zeros(10_000_000, np.uint8)  # longer than what the links lead to
        for link in {"mask": ["data/demo_0", "mask"]}.get(name, [name]):
            if link == "data/demo_0" and name == "mask":
                with h5py.File(tmp_path / "other.hdf5") as other:
                    other.copy("data", merged)
                continue
            merged[link] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), link)
    with pytest.raises(FormatError, match=f"{name} is a link"):
        with recordings.open_source(tmp_path / "merged.hdf5") as source:
            list(source.blocks("demo_0", datasets.IMAGES, 8))


def test_filter_keys_beyond_the_end_are_no_reason_to_refuse(tmp_path: Path) -> None:
    path = tmp_path / "cut.hdf5"
    shutil.copyfile(datasets.LIFT, path)
    before = path.stat().st_size
    with h5py.File(path, "r+") as file:
        file["mask/train"] = np.array([b"demo_0"])
    for number, size in enumerate(range(path.stat().st_size - 200, before - 1, -200)):
        os.truncate(path, size)
        saved = recordings.repair(path, tmp_path / f"{number}.hdf5")
        assert saved.kept == ("demo_0", "demo_1")


@pytest.mark.parametrize("kind", WAYS_OUT)
def test_camera_poses_lie_in_their_own_file(kind: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "traj.hdf5", "w") as file:
        group = file.create_group("traj_0/obs/sensor_param/front")
        group["intrinsic_cv"] = np.eye(3)
        lead_out(group, "extrinsic_cv", kind, tmp_path)
    with pytest.raises(FormatError, match="extrinsic_cv (is a link|lies in another file)"):
        from_maniskill(tmp_path / "traj.hdf5", None, [], (128, 128))


FRONT = "observation.images.front"


def renamed_feature(root: Path, name: str) -> None:
    """A LeRobot set whose camera has another name; the video stays where it was."""
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][name] = info["features"].pop(FRONT)
    info["video_path"] = info["video_path"].format(
        video_key=FRONT, chunk_index=0, file_index=0
    )  # without fields: the same for all
    (root / "meta/info.json").write_text(json.dumps(info))
    table = root / "meta/episodes/chunk-000/file-000.parquet"
    found = pq.read_table(table)
    names = [column.replace(FRONT, name) for column in found.column_names]
    pq.write_table(found.rename_columns(names), table)


@pytest.mark.parametrize("name", ["../../../../outside/evil", "/etc/evil", "..", "a\\b", "", "\0"])
def test_a_feature_names_no_file_elsewhere(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = datasets.lerobot(tmp_path)
    renamed_feature(root, name)
    out = tmp_path / "deep" / "er" / "out"
    out.parent.mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    assert main(["data", "repair", str(root), "--out", str(out)]) == 2
    assert "error: FormatError: " in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_other_names_of_features_are_fine(tmp_path: Path) -> None:
    root = datasets.lerobot(tmp_path)
    renamed_feature(root, "observation.images.left (RGB)")
    assert recordings.repair(root, tmp_path / "out").kept == ("0", "1")


@pytest.mark.parametrize("way", ["absolute", "dots", "link", "linked folder", "circle", "no field"])
@pytest.mark.parametrize("field", ["data_path", "video_path"])
def test_a_data_set_names_no_file_elsewhere(way: str, field: str, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir(), (tmp_path / "there").mkdir()
    root, other = datasets.lerobot(tmp_path / "here"), datasets.lerobot(tmp_path / "there")
    kind = {"data_path": "*.parquet", "video_path": "*.mp4"}[field]
    folder = field.partition("_")[0].replace("video", "videos")
    file, foreign = next((root / folder).rglob(kind)), next((other / folder).rglob(kind))
    names = {
        "absolute": str(foreign.resolve()), "no field": "{other}",
        "dots": f"../../there/set/{foreign.relative_to(other)}",
    }  # fmt: skip
    if way in names:
        info = json.loads((root / "meta/info.json").read_text()) | {field: names[way]}
        (root / "meta/info.json").write_text(json.dumps(info))
    elif way == "linked folder":
        shutil.rmtree(file.parent)
        file.parent.symlink_to(foreign.parent.resolve())
    else:
        file.unlink()
        file.symlink_to(file if way == "circle" else foreign.resolve())
    with pytest.raises(FormatError, match="leads out of the data set|expected a path with"):
        with recordings.open_source(root) as source:
            source.numbers("0", "action")
            list(source.blocks("0", FRONT, 8))


def test_a_hash_covers_no_file_elsewhere(tmp_path: Path) -> None:
    root = datasets.lerobot(tmp_path)
    (tmp_path / "private").write_text("secret")
    (root / "README.md").symlink_to(tmp_path / "private")
    with recordings.open_source(root) as source:
        with pytest.raises(FormatError, match="leads out of the data set.*cp -rL"):
            source.fingerprint()


def pictures_in_a_table(root: Path, item: dict[str, Any]) -> None:
    """The camera's frames as pictures in the table, all the same."""
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][FRONT]["dtype"] = "image"
    (root / "meta/info.json").write_text(json.dumps(info))
    file = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    pq.write_table(table.append_column(FRONT, pa.array([item] * len(table))), file)


def test_pictures_in_tables_lie_in_the_folder_and_run_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        EpsImagePlugin, "Ghostscript", lambda *args, **options: pytest.fail("Ghostscript is run")
    )
    content = io.BytesIO()
    Image.new("RGB", (128, 128)).save(content, "EPS")
    Image.new("RGB", (128, 128)).save(tmp_path / "private.png")
    for number, (item, words) in enumerate(
        [
            ({"bytes": None, "path": "../../private.png"}, "leads out of the data set"),
            ({"bytes": None, "path": str(tmp_path / "private.png")}, "leads out of the data set"),
            ({"bytes": content.getvalue(), "path": ""}, "an image that cannot be read"),
        ]
    ):
        (tmp_path / str(number)).mkdir()
        root = datasets.lerobot(tmp_path / str(number))
        pictures_in_a_table(root, item)
        with recordings.open_source(root) as source:
            with pytest.raises((FormatError, TruncatedError), match=words):
                source.image("0", FRONT, 1)


@pytest.mark.parametrize("function", ["blocks", "verify"])
def test_a_list_of_files_is_no_video(function: str, tmp_path: Path) -> None:
    """FFmpeg reads a list of videos as one video."""
    root = datasets.lerobot(tmp_path)
    video = next(root.rglob("*.mp4"))
    video.rename(video.with_name("private.mp4"))
    video.write_text("ffconcat version 1.0\nfile 'private.mp4'\n")
    if function == "verify":
        assert "not a readable video" in recordings.verify(root)["0"][0]
        return
    with recordings.open_source(root) as source:
        with pytest.raises(FormatError, match="not a readable video"):
            list(source.blocks("0", FRONT, 8))


def test_a_name_that_ffmpeg_takes_for_an_address_is_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = datasets.lerobot(tmp_path)
    video = next(root.rglob("*.mp4"))
    video.rename(root / "concat:private.mp4")
    info = json.loads((root / "meta/info.json").read_text())
    info["video_path"] = "concat:private.mp4"
    (root / "meta/info.json").write_text(json.dumps(info))
    monkeypatch.chdir(root)
    with recordings.open_source(Path(".")) as source:
        assert len(np.concatenate(list(source.blocks("0", FRONT, 8)))) == 15


def test_a_camera_names_no_file_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = datasets.robosuite(datasets.CAN).to_json()
    camera = content["cameras"].pop("agentview")
    camera["image"] = datasets.IMAGES
    content["cameras"]["x/../../escaped/evil"] = camera
    work = tmp_path / "a" / "b"
    work.mkdir(parents=True)
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    monkeypatch.chdir(work)
    words = [
        "data",
        "check",
        os.path.abspath(datasets.CAN),
        "--calibration",
        "../../calibration.json",
    ]
    assert main(words) == 0
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.png")] == [
        "a/b/robosuite_can-x-escaped-evil.png"
    ]


# ------------------------------------------------------------------------------------------ pages

HOSTILE = "<img src=x onerror=alert(1)>\"'&$\\frac{${|../../up"


class Seen(html.parser.HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: dict[str, list[str]] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            self.attributes.setdefault(name, []).append(value or "")


def hostile_run(folder: Path, **config: Any) -> None:
    """A run in which every text is hostile, but for the file names."""
    folder.mkdir(parents=True)
    some = {
        "success": np.arange(8) < 5, "nan": np.zeros(8, bool), "object_xy": np.zeros((8, 2)),
        "camera_angle": np.zeros(8), "length": np.ones(8), "draws": np.ones(8),
    }  # fmt: skip
    name = HOSTILE.replace("/", "")
    record = {"in_domain": some, name: some}
    records.save_eval(folder / "eval.npz", record)
    counts = {"successes": 5, "episodes": 8, "nan": 1}
    (folder / "eval.json").write_text(json.dumps({"in_domain": counts, name: counts}))
    variants = {"quoted": HOSTILE, HOSTILE: {f"viewpoint{HOSTILE}": counts, "viewpoint": counts}}
    (folder / "eval_variants.json").write_text(json.dumps(variants))
    (folder / "config.json").write_text(json.dumps({"method": HOSTILE, HOSTILE: HOSTILE, **config}))
    about = {
        "command": HOSTILE, "machine": HOSTILE, "date": HOSTILE, "commit": HOSTILE,
        "versions": {HOSTILE: HOSTILE}, "devices": [HOSTILE],
    }  # fmt: skip
    (folder / "env.json").write_text(json.dumps(about))
    lines = [json.dumps({"step": step, "loss": 1.0, HOSTILE: 2.0}) for step in range(3)]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n<script>\n")
    curve = records.StrengthSweep(HOSTILE, np.arange(2.0), np.ones((2, 3), bool), np.zeros((2, 3)))
    records.save_sweep(folder / "strength-x.npz", curve)


@pytest.mark.filterwarnings("ignore:Glyph")
def test_a_page_prints_hostile_texts_and_writes_below_its_folder(tmp_path: Path) -> None:
    root = tmp_path / "deep" / "runs"
    hostile_run(root / "a", task=HOSTILE, preset=HOSTILE, robot=HOSTILE, seed=HOSTILE)
    hostile_run(root / "b", task="../../../up")
    page = report.write_report(root).read_text()
    seen = Seen(page)
    assert "onerror" not in seen.attributes and "script" not in seen.tags
    assert all(value.startswith("data:") for value in seen.attributes["src"])
    assert "onerror=alert" in page and "<img src=x" not in page
    outside = [p for p in tmp_path.rglob("*") if p.is_file() and root not in p.parents]
    assert outside == []


def test_a_page_does_not_carry_what_links_point_at(tmp_path: Path) -> None:
    run = tmp_path / "run"
    hostile_run(run)
    Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "private.png")
    (tmp_path / "private.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    for folder, name in (("figures", "private.png"), ("videos", "private.mp4")):
        (run / folder).mkdir()
        (run / folder / name).symlink_to(tmp_path / name)
    found, clips = report._media(run, [])
    assert found == [] and clips == []


def test_a_table_page_stays_a_table(tmp_path: Path) -> None:
    cell = table_page.markdown(["a"], [["x | y\n\n<!-- table cpu: end --><script>"]])
    assert cell.splitlines()[2] == "| x \\| y &lt;!-- table cpu: end -->&lt;script> |"
    assert records.file_word("../../up/x y") == "-up-x-y" and records.file_word("lift_lid+a-1")


def test_a_run_folder_decides_no_path() -> None:
    """`out` and `data` of a config.json are notes: commands get both from their own words."""
    readers = [path for path in SOURCES if "stored_config(" in path.read_text()]
    for path in readers:
        if path.name == "workspace.py":  # makes it
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and dotted(node.value) in ("stored", "config"):
                assert node.attr not in ("out", "data", "backgrounds"), path
    assert {path.name for path in readers} == {"workspace.py", "sweep.py", "policy.py"}
