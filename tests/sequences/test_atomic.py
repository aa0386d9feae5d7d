"""A file is the old one or the new one, whatever happens to the process that writes it."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sequences import atomic

ROOT = Path(__file__).parents[2]
WRITER = """
import sys
from pathlib import Path
from sequences.atomic import write_json
print("ready", flush=True)
k = 0
while True:
    k += 1
    write_json(Path(sys.argv[1]), {"value": [k] * 20000, "last": k})
"""


@pytest.mark.parametrize("data", [b"", b"\x00\xff", b"x" * 1_000_000])
def test_what_is_written_is_what_is_read(tmp_path, data):
    path = tmp_path / "new" / "folder" / "file"
    atomic.write_bytes(path, b"old")
    atomic.write_bytes(path, data)
    assert path.read_bytes() == data
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_a_killed_writer_leaves_the_old_file_or_the_new(tmp_path):
    target = tmp_path / "result.json"
    atomic.write_json(target, {"value": [0] * 20000, "last": 0})
    rng = np.random.default_rng(0)
    written: list[int] = []
    # on a busy machine many a writer is killed before it has written anything
    while len(written) < 20 or (len(set(written)) < 2 and len(written) < 400):
        with subprocess.Popen([sys.executable, "-c", WRITER, target], cwd=ROOT, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(rng.uniform(0.0, 0.1))
            process.send_signal(signal.SIGKILL)
        result = json.loads(target.read_text())
        assert result["value"] == [result["last"]] * 20000
        written.append(result["last"])
    assert len(set(written)) > 1, "no process was killed after it had written anything"


def test_a_failed_write_leaves_the_old_file_and_nothing_beside(tmp_path, monkeypatch):
    target = tmp_path / "file"
    atomic.write_text(target, "old")

    def refuse(source, destination):
        raise OSError("no")

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OSError, match="no"):
        atomic.write_text(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), [1.0, -float("inf")]])
def test_json_without_numbers_is_refused(tmp_path, value):
    target = tmp_path / "file.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        atomic.write_json(target, {"value": value})
    assert not target.exists()


@pytest.mark.parametrize("can_exchange", [True, False])
@pytest.mark.parametrize("before", [None, [], ["old"]])
def test_a_folder_takes_the_place_of_another(tmp_path, monkeypatch, before, can_exchange):
    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda a, b: False)
    new, target = tmp_path / "new", tmp_path / "target"
    atomic.write_text(new / "file", "new")
    if before is not None:
        target.mkdir()
        for name in before:
            (target / name).write_text("old")
    atomic.replace_folder(new, target)
    assert [p.name for p in tmp_path.iterdir()] == ["target"]
    assert [p.name for p in target.iterdir()] == ["file"]


def test_folders_are_exchanged_in_one_step_here(tmp_path):
    if not sys.platform.startswith(("linux", "darwin")):
        pytest.skip("only Linux and macOS exchange folders")
    for name in "ab":
        atomic.write_text(tmp_path / name / f"was {name}", "")
    assert atomic._exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / "was b").exists()
    assert (tmp_path / "b" / "was a").exists()


def test_files_can_be_read_by_whom_the_umask_allows(tmp_path):
    atomic.write_text(tmp_path / "ours", "x")
    (tmp_path / "plain").write_text("x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_arrays_come_back_as_they_were_from_the_same_bytes_and_few_of_them(tmp_path):
    arrays = {"poses": np.tile(np.eye(4), (1000, 1, 1)), "meta": np.array("text"), "none": np.zeros((0, 6))}
    atomic.write_npz(tmp_path / "a.npz", arrays)
    atomic.write_npz(tmp_path / "b.npz", dict(reversed(arrays.items())))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert set(archive.files) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(archive[name], array)
    assert (tmp_path / "a.npz").stat().st_size < 0.1 * arrays["poses"].nbytes
