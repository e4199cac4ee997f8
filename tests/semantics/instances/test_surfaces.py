"""Classes of all pixels: their places, their codes, their files and pictures."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.overlay import draw_surfaces
from bmask_slam.semantics.instances.surface_files import (
    read_surfaces,
    surface_labels,
    write_surfaces,
)
from bmask_slam.semantics.instances.surfaces import (
    Segmented,
    SurfaceClasses,
    coded,
    most_probable,
)
from bmask_slam.semantics.labels import label_set

NAMES = label_set(("wall", "floor", "door"))


def classes(size: tuple[int, int] = (48, 64)) -> SurfaceClasses:
    """Wall above floor: the border is between rows 23 and 24, cells are of 8 pixels."""
    p = np.zeros((6, 8, 3), np.float16)
    p[:3, :, 0] = p[3:, :, 1] = 0.9
    p[:, :, 2] = 0.1
    return SurfaceClasses(NAMES, p, 8.0, size)


def test_a_pixel_lies_between_the_centres_of_cells() -> None:
    """The centre of the cell in row r is at pixel 8 r + 3.5."""
    seen = classes()
    found = seen.at(np.array([[20.0, 3.5], [20.0, 19.5], [20.0, 23.5], [20.0, 25.5], [63.0, 47.0]]))
    assert found[:, 0] == pytest.approx([0.9, 0.9, 0.45, 0.225, 0.0], abs=1e-3)
    assert found[:, 1] == pytest.approx([0.0, 0.0, 0.45, 0.675, 0.9], abs=1e-3)
    whole = seen.pixels()
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(48)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(whole.reshape(-1, 3), seen.at(grid.astype(float)), atol=1e-3)


def test_all_pixels_have_classes_where_the_cells_end_before_the_edge() -> None:
    """The network's input has whole pixels: of an image of 986 x 1280 the last row has no cell."""
    found = classes((50, 65)).pixels()
    assert found.shape == (50, 65, 3)
    np.testing.assert_array_equal(found[48:], found[[47, 47]])
    one = SurfaceClasses(label_set(("wall",)), np.ones((6, 8, 1), np.float16), 8.0, (48, 64))
    assert one.pixels().shape == (48, 64, 1)


def test_the_likeliest_class_of_pixels() -> None:
    label, p = most_probable(classes((45, 60)))
    assert label.shape == p.shape == (45, 60)
    assert (label[:24] == 1).all()
    assert (label[24:] == 2).all()
    assert p[0, 0] == pytest.approx(0.9, abs=1e-3)


def test_codes_tell_the_likeliest_class_of_the_cell_of_a_pixel() -> None:
    seen = classes()
    kept = coded(seen)
    columns, rows = np.meshgrid(np.arange(8) * 8.0 + 5, np.arange(6) * 8.0 + 2)
    codes = kept.codes_at(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    p = kept.decoded(codes, kept.labels).reshape(6, 8, -1)
    np.testing.assert_array_equal(p.argmax(axis=2), seen.probabilities.argmax(axis=2))
    np.testing.assert_allclose(p.max(axis=2), seen.probabilities.max(axis=2), atol=3e-3)
    np.testing.assert_allclose(p.sum(axis=2), 1, atol=5e-3)
    assert kept.codes_at(np.array([[-9.0, 999.0]])) == kept.codes[5, 0]


def test_files_keep_the_likeliest_class(tmp_path: Path) -> None:
    seen = classes()
    assert surface_labels(tmp_path) is None
    write_surfaces(tmp_path, "rgb/1.5.jpg", seen)
    labels = surface_labels(tmp_path)
    assert labels == NAMES
    again = read_surfaces(tmp_path, "rgb/1.5.jpg", NAMES, (48, 64))
    assert again is not None
    assert again.cell_px == 8
    np.testing.assert_array_equal(again.codes(), seen.codes())
    assert again.probabilities[0, 0] == pytest.approx([0.9, 0.05, 0.05], abs=3e-3)
    assert read_surfaces(tmp_path, "rgb/2.jpg", NAMES, (48, 64)) is None
    with pytest.raises(InputError, match="another shape"):
        read_surfaces(tmp_path, "rgb/1.5.jpg", NAMES, (64, 48))


def test_more_cells_than_pixels_are_refused(tmp_path: Path) -> None:
    """Of the image's shape, but a hundred times as large."""
    path = tmp_path / "surfaces" / "a.png"
    path.parent.mkdir()
    cv2.imwrite(str(path), np.full((960, 1280), 300, np.uint16))
    with pytest.raises(InputError, match=r"a\.png: more cells than"):
        read_surfaces(tmp_path, "a.jpg", NAMES, (96, 128))
    assert read_surfaces(tmp_path, "a.jpg", NAMES, (960, 1280)) is not None


def test_a_folder_holds_classes_of_one_label_set(tmp_path: Path) -> None:
    write_surfaces(tmp_path, "a.jpg", classes())
    other = SurfaceClasses(label_set(("floor", "wall", "door")), classes().probabilities, 8.0,
                           (48, 64))  # fmt: skip
    with pytest.raises(InputError, match=r"classes\.txt: other classes .* another --out"):
        write_surfaces(tmp_path, "b.jpg", other)
    write_surfaces(tmp_path, "b.jpg", classes())


def test_segmented_is_a_list_that_other_processes_get_whole() -> None:
    found = pickle.loads(pickle.dumps(Segmented([], classes())))
    assert found == []
    np.testing.assert_array_equal(found.surfaces.probabilities, classes().probabilities)


def test_areas_have_their_colours() -> None:
    large = SurfaceClasses(NAMES, classes().probabilities, 40.0, (240, 320))
    drawn = draw_surfaces(np.zeros((240, 320, 3), np.uint8), large).astype(int)
    assert (drawn[2, 2] == drawn[2, 300]).all()
    assert np.abs(drawn[2, 2] - drawn[235, 2]).max() > 40


def test_more_classes_than_a_code_can_tell_are_refused() -> None:
    labels = label_set([f"c{k}" for k in range(256)])
    seen = SurfaceClasses(labels, np.full((1, 1, 256), 1 / 256, np.float16), 8.0, (8, 8))
    with pytest.raises(InputError, match="256 classes; give at most 255"):
        seen.codes()
