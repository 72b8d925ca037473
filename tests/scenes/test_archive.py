"""A scene as one file: the same scene comes out, equal meshes are in it once, and files may go with it."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import pickle
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError, StorageError
from steadylight.scenes import load_scene
from steadylight.scenes.archive import is_archive_of, read_archive, write_archive
from steadylight.scenes.description import SceneDescription


def described(content, files=()):
    """A scene with some content, which refers to some files."""
    hashes = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    still = CameraPath((Keyframe(0.0, (0, 0, 0), (1, 0, 0)),))
    return SceneDescription(name="small", content=content, camera=still, files=hashes)


def mesh(seed):
    vertices = np.random.default_rng(seed).random((1000, 3), np.float32)
    return {
        "type": "triangles",
        "vertices": vertices,
        "faces": np.arange(999, dtype=np.uint32).reshape(-1, 3),
    }


@pytest.fixture
def textured(tmp_path):
    """A scene with two files of equal content in folders that other machines do not see, and a third."""
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, content in (("a.png", b"red"), ("copy.png", b"red"), ("mesh.obj", b"v 0 0 0")):
        (folder / name).write_bytes(content)
    content = {
        "wall": {"type": "obj", "filename": str(folder / "mesh.obj")},
        "paint": [{"filename": str(folder / "a.png")}, {"filename": str(folder / "copy.png"), "raw": True}],
    }
    return folder, described(content, sorted(folder.iterdir()))


def test_a_bundled_scene_comes_out_as_it_went_in(tmp_path):
    scene = load_scene("corridor")
    write_archive(tmp_path / "scene.zip", scene, with_files=False)
    found = read_archive(tmp_path / "scene.zip")
    assert found.hash == scene.hash
    assert found.camera == scene.camera
    assert dataclasses.replace(found, content={}) == dataclasses.replace(scene, content={})


def test_equal_meshes_are_stored_once(tmp_path):
    sizes = []
    for content in ({"a": mesh(1)}, {"a": mesh(1), "b": mesh(1)}, {"a": mesh(1), "b": mesh(2)}):
        write_archive(tmp_path / "scene.zip", described(content), with_files=False)
        sizes.append((tmp_path / "scene.zip").stat().st_size)
        assert read_archive(tmp_path / "scene.zip").hash == described(content).hash
    one, twice, two = sizes
    assert twice < 1.05 * one
    assert two > 1.8 * one


def test_images_are_stored_as_they_are_and_the_bytes_do_not_depend_on_the_time(tmp_path, monkeypatch):
    noise = np.random.default_rng(3).integers(0, 256, 50_000, np.uint8)
    image = np.concatenate([np.frombuffer(b"\x89PNG", np.uint8), noise])
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff" + noise.tobytes())
    os.utime(tmp_path / "a.jpg", (0, 0))  # zip knows no time before 1980
    paint = {"type": "image", "encoded": image, "channels": "rgb"}
    scene = described({"a": mesh(1), "paint": paint, "again": paint}, [tmp_path / "a.jpg"])
    for name, moment in (("one.zip", 1e9), ("two.zip", 1.5e9)):
        monkeypatch.setattr("time.time", lambda moment=moment: moment)
        write_archive(tmp_path / name, scene, with_files=True)
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        kinds = {info.filename.split("/")[0]: info.compress_type for info in archive.infolist()}
    assert kinds == {
        "description.pickle": zipfile.ZIP_DEFLATED,
        "images": zipfile.ZIP_STORED,
        "files": zipfile.ZIP_STORED,
    }
    assert is_archive_of(tmp_path / "one.zip", scene, with_files=True)
    assert read_archive(tmp_path / "one.zip").hash == scene.hash


def test_arrays_of_equal_bytes_but_other_type_or_shape_stay_apart(tmp_path):
    content = {
        "float": np.zeros((2, 2), np.float32),
        "int": np.zeros((2, 2), np.int32),
        "flat": np.zeros(4, np.float32),
    }
    write_archive(tmp_path / "scene.zip", described(content), with_files=False)
    found = read_archive(tmp_path / "scene.zip").content
    assert all(found[name].dtype == array.dtype for name, array in content.items())
    assert all(found[name].shape == array.shape for name, array in content.items())


def test_files_that_go_with_a_scene_are_found_where_the_originals_are_not(tmp_path, textured):
    folder, scene = textured
    write_archive(tmp_path / "scene.zip", scene, with_files=True)
    for path in folder.iterdir():
        path.unlink()
    found = read_archive(tmp_path / "scene.zip")
    assert found.hash == scene.hash
    assert Path(found.content["wall"]["filename"]).read_bytes() == b"v 0 0 0"
    first, second = found.content["paint"]
    assert Path(first["filename"]).read_bytes() == b"red"
    assert second == {"filename": first["filename"], "raw": True}
    assert set(found.files) == {first["filename"], found.content["wall"]["filename"]}


def test_without_its_files_a_scene_refers_to_the_originals(tmp_path, textured):
    folder, scene = textured
    write_archive(tmp_path / "scene.zip", scene, with_files=False)
    assert read_archive(tmp_path / "scene.zip") == scene
    (folder / "a.png").unlink()
    with pytest.raises(StorageError, match=r"a\.png \(scene small\) cannot be read on this machine"):
        read_archive(tmp_path / "scene.zip")


def test_a_file_that_has_changed_since_is_refused(tmp_path, textured):
    folder, scene = textured
    write_archive(tmp_path / "scene.zip", scene, with_files=False)
    (folder / "mesh.obj").write_bytes(b"v 1 0 0")
    with pytest.raises(SceneError, match=r"mesh\.obj \(scene small\) has changed since the run began"):
        read_archive(tmp_path / "scene.zip")
    with pytest.raises(SceneError, match="has changed"):
        write_archive(tmp_path / "scene.zip", scene, with_files=True)


def test_a_damaged_archive_is_named(tmp_path):
    path = tmp_path / "scene.zip"
    write_archive(path, described({"a": mesh(1)}), with_files=False)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SceneError, match=r"scene\.zip: the scene cannot be read"):
        read_archive(path)


def test_what_was_asked_of_a_camera_path_before_changes_no_byte(tmp_path):
    keyframes = tuple(Keyframe(float(t), (t, 0, 0), (t + 1, 1, 0)) for t in range(3))
    scene = dataclasses.replace(described({"a": mesh(1)}), camera=CameraPath(keyframes))
    write_archive(tmp_path / "before.zip", scene, with_files=False)
    poses = scene.camera.frame_poses([1, 20], 25.0)
    write_archive(tmp_path / "after.zip", scene, with_files=False)
    assert (tmp_path / "before.zip").read_bytes() == (tmp_path / "after.zip").read_bytes()
    found = read_archive(tmp_path / "after.zip").camera.frame_poses([1, 20], 25.0)
    np.testing.assert_array_equal([p.to_world for p in found], [p.to_world for p in poses])


class Evil:
    """Its pickle calls what makes a file."""

    def __reduce__(self):
        return exec, ("open('was-run', 'w')",)


@pytest.mark.parametrize("evil", [Evil(), described({"a": Evil()})])
def test_nothing_in_an_archive_of_somebody_else_is_executed(tmp_path, monkeypatch, evil):
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("scene.zip", "w") as archive:
        archive.writestr("description.pickle", pickle.dumps(evil))
    with pytest.raises(
        SceneError, match=r"scene\.zip: .* refers to builtins\.exec, which is not part of a scene"
    ):
        read_archive(Path("scene.zip"))
    assert not Path("was-run").exists()


@pytest.mark.parametrize("name", ["np.memmap", "np", "Path", "Curve.__class__"])
def test_of_our_own_modules_nothing_but_their_classes_is_called(tmp_path, name):
    victim = tmp_path / "thesis.tex"
    victim.write_text("precious")
    module = "steadylight.camera.files" if name == "Path" else "steadylight.camera.path"
    call = b"".join(b"\x8c" + bytes([len(each)]) + each.encode() for each in (module, name)) + b"\x93"
    argument = b"X" + len(str(victim)).to_bytes(4, "little") + str(victim).encode()
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        archive.writestr("description.pickle", b"\x80\x04" + call + argument + b"\x85R.")
    with pytest.raises(
        SceneError, match=rf"refers to {re.escape(f'{module}.{name}')}, which is not part of a scene"
    ):
        read_archive(tmp_path / "scene.zip")
    assert victim.read_text() == "precious"


def test_an_archive_is_recognised_without_being_executed(tmp_path, textured):
    _, scene = textured
    path = tmp_path / "scene.zip"
    assert not is_archive_of(path, scene, with_files=True)
    write_archive(path, scene, with_files=True)
    assert is_archive_of(path, scene, with_files=True)
    assert not is_archive_of(path, scene, with_files=False)
    assert not is_archive_of(path, dataclasses.replace(scene, name="another"), with_files=True)
    (tmp_path / "link.zip").symlink_to(path)
    assert not is_archive_of(tmp_path / "link.zip", scene, with_files=True)


def test_a_flipped_bit_of_an_archive_is_found_or_changes_nothing(tmp_path):
    scene = described({"a": mesh(1)})
    path = tmp_path / "scene.zip"
    write_archive(path, scene, with_files=False)
    content = path.read_bytes()
    for place in range(0, len(content), 97):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        if is_archive_of(path, scene, with_files=False):
            assert read_archive(path).hash == scene.hash


@pytest.mark.parametrize("place", ["scene", "scene/files"])
def test_files_of_an_archive_are_not_written_through_links(place, tmp_path, textured):
    _, scene = textured
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    for folder in (run / place).parent, elsewhere:
        folder.mkdir(parents=True)
    (run / place).symlink_to(elsewhere)
    write_archive(run / "scene.zip", scene, with_files=True)
    with pytest.raises(StorageError, match=rf"{place}: is a symbolic link; remove it"):
        read_archive(run / "scene.zip")
    assert list(elsewhere.iterdir()) == []


def test_a_file_of_an_archive_replaces_a_link_and_leaves_its_target(tmp_path, textured):
    _, scene = textured
    (tmp_path / "scene/files").mkdir(parents=True)
    write_archive(tmp_path / "scene.zip", scene, with_files=True)
    (tmp_path / "thesis.tex").write_text("precious")
    for name, digest in scene.files.items():
        (tmp_path / f"scene/files/{digest}{Path(name).suffix}").unlink(missing_ok=True)
        (tmp_path / f"scene/files/{digest}{Path(name).suffix}").symlink_to(tmp_path / "thesis.tex")
    assert read_archive(tmp_path / "scene.zip").hash == scene.hash
    assert (tmp_path / "thesis.tex").read_text() == "precious"
