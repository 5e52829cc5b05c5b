"""`Views`: what is stored, how it is chosen from, and what is refused."""

import copy
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils._pytree import tree_flatten, tree_unflatten

from diffproj.targets.views import Views, view_number


def some_views(*shape, **options):
    """Views of corners between 0 and 500 px, the same each time."""
    generator = torch.Generator().manual_seed(0)
    pixels = 500 * torch.rand(*(shape or (5, 12)), 2, generator=generator, dtype=torch.float64)
    return Views(pixels, **options)


# --------------------------------------------------------------------------------------------------- what is stored


def test_defaults():
    views = some_views()
    assert views.pixels.shape == (5, 12, 2)
    assert views.visible.shape == (5, 12)
    assert views.visible.all()
    assert views.names == ("view 1", "view 2", "view 3", "view 4", "view 5")
    assert (views.size, views.batch_shape, len(views)) == (None, (), 5)
    assert (views.dtype, views.device) == (torch.float64, torch.device("cpu"))


@pytest.mark.parametrize("kind", [list, np.array, torch.tensor])
def test_every_kind_of_numbers(kind):
    """Nested lists and NumPy's float64 are float64; PyTorch keeps what it made of them."""
    numbers = [[[1.5, 2.0], [3.0, 4.0]]]
    views = Views(kind(numbers))
    assert views.pixels.tolist() == numbers
    assert views.dtype == (torch.float32 if kind is torch.tensor else torch.float64)
    assert Views([[[1, 2], [3, 4]]]).dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_half_precision_is_lifted(dtype):
    assert Views(torch.ones(2, 3, 2, dtype=dtype)).dtype == torch.float32


@pytest.mark.parametrize("mask", [None, torch.ones(2, 3, dtype=torch.bool)])
def test_nothing_is_shared_with_the_caller(mask):
    pixels = torch.rand(2, 3, 2)
    views = Views(pixels, mask)
    before = views.pixels.clone()
    pixels.fill_(-1.0)
    if mask is not None:
        mask.fill_(False)
    assert torch.equal(views.pixels, before)
    assert views.visible.all()


def test_unseen_corners_are_zero_and_the_callers_tensor_is_left_alone():
    pixels = torch.rand(2, 3, 2)
    pixels[0, 1] = torch.nan
    pixels[1, 2, 0] = torch.inf
    original = pixels.clone()
    visible = pixels.isfinite().all(dim=-1)
    views = Views(pixels, visible)
    assert views.pixels[~visible].tolist() == [[0, 0], [0, 0]]
    assert torch.equal(views.pixels[visible], original[visible])
    torch.testing.assert_close(pixels, original, equal_nan=True, rtol=0, atol=0)
    assert "2 hidden" in repr(views)


def test_gradients_reach_seen_corners_only():
    pixels = torch.rand(2, 3, 2)
    pixels[0, 1] = torch.nan
    pixels.requires_grad_()
    visible = torch.tensor([[True, False, True], [True, True, True]])
    Views(pixels, visible)[[0, 0, 1]].pixels.sum().backward()
    assert pixels.grad[..., 0].tolist() == [[2, 0, 2], [1, 1, 1]]


def test_cameras_side_by_side():
    """The mask's batch axes broadcast against those of the pixels, either way."""
    views = Views(torch.rand(4, 3, 2), torch.ones(7, 4, 3, dtype=torch.bool))
    assert views.batch_shape == (7,)
    assert views.pixels.shape == (7, 4, 3, 2)
    views = Views(torch.rand(2, 7, 4, 3, 2), torch.ones(7, 1, 4, 3, dtype=torch.bool)[:, 0])
    assert views.visible.shape == (2, 7, 4, 3)
    assert len(views) == 4
    assert repr(views) == "Views(2 x 7 cameras, 4 views of 3 corners, torch.float32)"


def test_no_views_at_all():
    views = Views(torch.empty(0, 54, 2))
    assert (len(views), views.names, list(views)) == (0, (), [])


# ------------------------------------------------------------------------------------------------- choosing views


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (3, [3]),
        (-1, [4]),
        (np.int64(2), [2]),
        (torch.tensor(2), [2]),
        (slice(2, 5), [2, 3, 4]),
        (slice(None, None, -2), [4, 2, 0]),
        ([0, 3], [0, 3]),
        ((0, 3), [0, 3]),
        ([3, 0, -5, 3], [3, 0, 0, 3]),
        (range(1, 3), [1, 2]),
        ([], []),
        (np.array([4, 1], dtype=np.uint8), [4, 1]),
        (torch.tensor([4, 1]), [4, 1]),
        ([True, False, False, True, False], [0, 3]),
        (np.array([False, True, True, False, False]), [1, 2]),
        (torch.tensor([False, False, False, False, True]), [4]),
    ],
)
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_indexing(index, expected, batch):
    names = list("abcde")
    visible = torch.rand(*batch, 5, 12, generator=torch.Generator().manual_seed(1)) < 0.8
    views = some_views(*batch, 5, 12, visible=visible, names=names, size=(640, 480))
    chosen = views[index]
    assert chosen.names == tuple(names[i] for i in expected)
    assert chosen.size == (640, 480)
    assert torch.equal(chosen.pixels, views.pixels[..., expected, :, :])
    assert torch.equal(chosen.visible, views.visible[..., expected, :])


@given(st.data())
def test_indexing_is_python_indexing(data):
    """Whatever one may do to a list of names, the names of the views follow."""
    count = data.draw(st.integers(1, 6))
    views, names = some_views(count, 3), [f"view {i + 1}" for i in range(count)]
    cut = data.draw(st.slices(count))
    assert list(views[cut].names) == names[cut]
    picked = data.draw(st.lists(st.integers(-count, count - 1), max_size=8))
    assert list(views[picked].names) == [names[i] for i in picked]


def test_iterating_gives_single_views():
    views = some_views()
    singles = list(views)
    assert [single.names for single in singles] == [(name,) for name in views.names]
    assert torch.equal(torch.cat([single.pixels for single in singles]), views.pixels)


@pytest.mark.parametrize("index", [5, -6, [0, 5], 1.0, "view 1", None, [True, False], [[0, 1], [2, 3]], [0.5], ...])
def test_wrong_indices(index):
    with pytest.raises((IndexError, TypeError), match="index: want"):
        some_views()[index]


# ------------------------------------------------------------------------------------------------- hiding and moving


def test_hiding_the_same_corners_in_every_view():
    views = some_views()
    odd = torch.arange(12) % 2 == 1
    fit, test = views.hiding(odd), views.hiding(~odd)
    assert torch.equal(fit.visible, (~odd).expand(5, 12))
    assert torch.equal(fit.pixels + test.pixels, views.pixels)
    assert (fit.pixels[:, odd] == 0).all()
    assert views.visible.all()


def test_hiding_adds_up():
    views = some_views(2, 5, 12)
    first, second = np.arange(12) < 3, torch.zeros(2, 5, 12, dtype=torch.bool)
    second[1, 2, 7] = True
    hidden = views.hiding(first).hiding(second)
    assert int((~hidden.visible).sum()) == 2 * 5 * 3 + 1
    assert not hidden.visible[1, 2, 7]


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        (torch.zeros(12), TypeError),
        (list(range(12)), TypeError),
        (torch.zeros(11, dtype=torch.bool), ValueError),
        (torch.zeros(3, 5, 12, dtype=torch.bool), ValueError),
    ],
)
def test_hiding_mistakes(mask, error):
    with pytest.raises(error, match="mask: want"):
        some_views().hiding(mask)


def test_to_a_dtype():
    views = some_views(visible=torch.eye(5, 12) == 0, names=list("abcde"), size=(640, 480))
    single = views.to(torch.float32)
    assert (single.dtype, single.names, single.size) == (torch.float32, views.names, views.size)
    assert torch.equal(single.visible, views.visible)
    assert views.dtype == torch.float64
    assert views.to(dtype=torch.float16).dtype == torch.float32
    assert views.to("meta").device.type == "meta"
    assert views.to("meta").visible.device.type == "meta"
    assert "torch.float64" in repr(views.to("meta"))
    with pytest.raises(TypeError, match=r"dtype: want a floating-point one, got torch\.int64"):
        views.to(torch.int64)


# ------------------------------------------------------------------------------------------ under transformations


def test_pytree_round_trip():
    views = some_views(names=list("abcde"), size=(640, 480))
    leaves, tree = tree_flatten(views)
    assert [leaf.shape for leaf in leaves] == [(5, 12, 2), (5, 12)]
    again = tree_unflatten(leaves, tree)
    assert (again.names, again.size) == (views.names, views.size)


def test_vmap_over_cameras():
    """Views go into `vmap`, can be built and masked inside, and come out: as a loop over cameras gives."""
    views = some_views(3, 5, 12)
    even = torch.arange(12) % 2 == 0

    def inside(one):
        return Views(one.pixels * 2, one.visible, one.names)[1:3].hiding(even)

    result = torch.vmap(inside)(views)
    assert result.batch_shape == (3,)
    assert result.names == ("view 2", "view 3")
    for camera in range(3):
        alone = inside(Views(views.pixels[camera]))
        assert torch.equal(result.pixels[camera], alone.pixels)
        assert torch.equal(result.visible[camera], alone.visible)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda views: pickle.loads(pickle.dumps(views))])  # noqa: S301
def test_copies(again):
    views = some_views(names=list("abcde"), size=(640, 480))
    other = again(views)
    assert torch.equal(other.pixels, views.pixels)
    assert torch.equal(other.visible, views.visible)
    assert (other.names, other.size) == (views.names, views.size)


# ------------------------------------------------------------------------------------------------------- mistakes

PIXELS = torch.ones(2, 3, 2)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"pixels": torch.ones(3, 2)}, ValueError, r"pixels: want shape \(\*B, V, N, 2\), got \(3, 2\)"),
        ({"pixels": torch.ones(2, 3, 3)}, ValueError, "pixels: want shape"),
        ({"pixels": torch.ones(2, 3, 2, dtype=torch.int64)}, TypeError, "pixels: want a floating-point tensor"),
        (
            {"pixels": np.ones((2, 3, 2), dtype=complex)},
            TypeError,
            "pixels: want a tensor, an array or numbers, got .*c",
        ),
        ({"pixels": [[[1.0, 2.0], [3.0]]]}, TypeError, "pixels: want .* lists of numbers of equal lengths"),
        ({"pixels": "corners"}, TypeError, "pixels: want"),
        ({"pixels": None}, TypeError, "pixels"),
        ({"visible": torch.ones(2, 3)}, TypeError, "visible: want booleans, got torch.float32"),
        ({"visible": np.ones((2, 3), dtype=int)}, TypeError, "visible: want booleans"),
        ({"visible": torch.ones(3, 3, dtype=torch.bool)}, ValueError, r"visible: want shape \(\*B, 2, 3\)"),
        ({"visible": torch.ones(3, dtype=torch.bool)}, ValueError, "visible: want shape"),
        ({"visible": torch.ones(2, 3, dtype=torch.bool, device="meta")}, ValueError, "visible: want device cpu"),
        ({"names": ["left"]}, ValueError, "names: want 2, one for each view of pixels, got 1"),
        ({"names": "ab"}, TypeError, "names: want 2 strings, got 'ab'"),
        ({"names": [1, 2]}, TypeError, "names"),
        ({"names": 2}, TypeError, "names"),
        ({"size": (640, 480, 3)}, TypeError, r"size: want \(width, height\) in whole px"),
        ({"size": (640.5, 480)}, TypeError, "size"),
        ({"size": 640}, TypeError, "size"),
        ({"size": (0, 480)}, ValueError, "size: want a positive width and height"),
    ],
)
def test_mistakes_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        Views(**({"pixels": PIXELS} | arguments))


def test_batch_shapes_that_do_not_fit():
    with pytest.raises(ValueError, match=r"do not broadcast: pixels \(2,\), visible \(3,\)"):
        Views(torch.ones(2, 4, 5, 2), torch.ones(3, 4, 5, dtype=torch.bool))


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_visible_corner_must_be_finite(value):
    pixels = torch.ones(2, 3, 2)
    pixels[1, 2, 0] = value
    with pytest.raises(ValueError, match=r"pixels: want finite .* at 'b' \(view 1\), corner 2; visible"):
        Views(pixels, names=["a", "b"])
    with pytest.raises(ValueError, match=r"camera \(1,\), 'view 2' \(view 1\), corner 2"):
        Views(torch.stack([torch.ones(2, 3, 2), pixels]))


def test_a_name_of_several_views_names_none() -> None:
    with pytest.raises(ValueError, match="view: want the number of one, got 'a', which is the name of several"):
        view_number("a", ["b", "a", "a"])
    assert view_number("b", ["b", "a", "a"]) == 0
    assert view_number(2, ["b", "a", "a"]) == 2


def test_what_files_tell_goes_along_into_views_that_are_made_from_others() -> None:
    pixels, told = torch.rand(2, 6, 2), ((("focal", 24.0), ("camera", "Nikon")), ())
    views = Views(pixels, told=told)
    assert views.told == told
    assert Views(views.pixels, told=views[[1, 0]].told).told == told[::-1]
    assert Views(pixels, told=()).told == Views(pixels).told == ()
    with pytest.raises(ValueError, match="told: want 2, one for each view of pixels, got 1"):
        Views(pixels, told=told[:1])
    for wrong in (
        "24 mm",
        ["a", "b"],
        [("focal", 24.0), ()],
        [(("focal",),), ()],
        [((1, 2),), ()],
        [(("a", None),), ()],
    ):
        with pytest.raises(TypeError, match="told: want"):
            Views(pixels, told=wrong)
