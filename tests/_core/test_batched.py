"""One set of laws for everything that is made of tensors with batch axes in front."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_leaves, tree_unflatten

import diffproj as dp
from diffproj._core.batched import Batched

D = torch.float64


def draws(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=D)


def camera(*batch: int, lens: Any = None) -> dp.Camera:
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D) + torch.zeros(*batch, 3, 3, dtype=D)
    K[..., 0, 0] += draws(*batch)
    return dp.Camera(K, t=draws(*batch, 3), distortion=lens, size=(640, 480))


def brown(*batch: int) -> dp.BrownConrady:
    return dp.BrownConrady(0.01 * draws(*batch, 5))


def fisheye(*batch: int) -> dp.KannalaBrandt:
    return dp.KannalaBrandt(0.01 * draws(*batch, 4))


def views(*batch: int) -> dp.Views:
    return dp.Views(draws(*batch, 4, 6, 2), draws(*batch, 4, 6) > -1, names=list("abcd"), size=(640, 480))


MAKERS: dict[str, Callable[..., Batched]] = {
    "pinhole": camera,
    "camera": lambda *batch: camera(*batch, lens=brown(*batch)),
    "one lens for all": lambda *batch: camera(*batch, lens=brown()),
    "plane": lambda *batch: dp.Plane(draws(*batch, 3), draws(*batch)),
    "brown": brown,
    "fisheye": fisheye,
    "views": views,
}
every = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
indexed = pytest.mark.parametrize(  # the axis that Views index is that of the photographs
    "make", [make for name, make in MAKERS.items() if name != "views"], ids=[name for name in MAKERS if name != "views"]
)


def tensors(item: Batched) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(item) if isinstance(leaf, Tensor)]


def same(a: Batched, b: Batched) -> bool:
    (left, one), (right, other) = tree_flatten(a), tree_flatten(b)
    return one == other and all(torch.equal(x, y) for x, y in zip(left, right, strict=True))


@every
def test_shape_dtype_device(make: Callable[..., Batched]) -> None:
    for batch in ((), (3,), (2, 3)):
        item = make(*batch)
        assert item.batch_shape == batch
        assert (item.dtype, item.device) == (D, torch.device("cpu"))


@every
def test_to(make: Callable[..., Batched]) -> None:
    item = make(3)
    single = item.to(torch.float32)
    assert type(single) is type(item)
    assert single.batch_shape == item.batch_shape
    assert {tensor.dtype for tensor in tensors(single)} <= {torch.float32, torch.bool}
    for tensor, want in zip(tensors(single), tensors(item), strict=True):
        assert torch.equal(tensor, want if want.dtype == torch.bool else want.float())
    assert item.dtype == D
    assert {tensor.dtype for tensor in tensors(item.to(torch.bfloat16))} <= {torch.float32, torch.bool}
    assert {tensor.device.type for tensor in tensors(item.to("meta"))} == {"meta"}
    with pytest.raises(TypeError, match=r"dtype: want a floating-point one, got torch\.int64"):
        item.to(torch.int64)


@every
def test_to_keeps_what_is_expanded_expanded(make: Callable[..., Batched]) -> None:
    item = make().expand(1000)
    for tensor in tensors(item.to(torch.float32)):
        assert tensor.untyped_storage().nbytes() < 1000


@every
def test_detach(make: Callable[..., Batched]) -> None:
    item = make(3)
    leaves, structure = tree_flatten(item)
    leaves = [leaf.clone().requires_grad_() if leaf.is_floating_point() else leaf for leaf in leaves]
    grown = tree_unflatten(leaves, structure)
    assert any(tensor.requires_grad for tensor in tensors(grown))
    assert not any(tensor.requires_grad for tensor in tensors(grown.detach()))
    assert same(grown.detach(), item)


@every
def test_expand(make: Callable[..., Batched]) -> None:
    one, row = make(), make(3)
    assert one.expand(2, 3).batch_shape == (2, 3)
    assert row.expand(4, 3).batch_shape == (4, 3)
    for wide, want in zip(tensors(row.expand(4, 3)), tensors(row), strict=True):
        assert wide.untyped_storage().data_ptr() == want.untyped_storage().data_ptr()
        assert all(torch.equal(part, want) for part in wide)
    with pytest.raises(ValueError, match="batch_shape: want"):
        row.expand(4)


@indexed
@pytest.mark.parametrize(
    "index",
    [
        0,
        -1,
        slice(1, None),
        [1, 0],
        (slice(None), 2),
        (..., 0),
        None,
        torch.tensor([1, 1]),
        np.array([0]),
        torch.tensor([[True, False, True], [False, False, True]]),
    ],
    ids=str,
)
def test_indexing_is_a_tensors(make: Callable[..., Batched], index: Any) -> None:
    item, numbers = make(2, 3), torch.arange(6).reshape(2, 3)
    got = item[index]
    want = numbers[index].flatten().tolist()
    assert got.batch_shape == numbers[index].shape
    assert type(got) is type(item)
    for tensor, whole in zip(tensors(got), tensors(item), strict=True):
        flat = whole.flatten(0, 1)
        assert torch.equal(tensor.reshape(len(want), *flat.shape[1:]), flat[want])


@indexed
def test_what_is_no_index_is_refused(make: Callable[..., Batched]) -> None:
    for index in ("0", 1.0, dp.example_views("left"), make(3), (0, "1"), {0}):
        with pytest.raises(TypeError, match="index: want numbers, slices, lists or masks, got"):
            make(2, 3)[index]
    with pytest.raises(IndexError):
        make(3)[3]


@indexed
def test_length_and_iteration(make: Callable[..., Batched]) -> None:
    item = make(3, 2)
    assert len(item) == 3
    assert [part.batch_shape for part in item] == [(2,)] * 3
    assert all(same(part, item[i]) for i, part in enumerate(item))
    for go_through in (len, list):
        with pytest.raises(TypeError, match="no batch axes"):
            go_through(make())
    assert bool(make())
    assert bool(make(0))


@every
@pytest.mark.parametrize("dim", [0, 1, -1])
def test_stack(make: Callable[..., Batched], dim: int) -> None:
    item = make(3)
    joined = type(item).stack([item, item, item, item], dim)
    assert joined.batch_shape == ((4, 3) if dim == 0 else (3, 4))
    for tensor, want in zip(tensors(joined), tensors(item), strict=True):
        assert all(torch.equal(part, want) for part in tensor.unbind(dim % 2))
    assert type(item).stack([make(), item]).batch_shape == (2, 3)
    with pytest.raises(ValueError, match="dim: want an axis from -2 to 1, got 2"):
        type(item).stack([item, item], 2)


@every
@pytest.mark.plain
def test_what_cannot_be_stacked_is_refused(make: Callable[..., Batched]) -> None:
    item = make(3)
    with pytest.raises(ValueError, match=f"items: want at least one {type(item).__name__}, got none"):
        type(item).stack([])
    with pytest.raises(TypeError, match=f"items: want at least one {type(item).__name__}, got .*str"):
        type(item).stack([item, "item"])
    with pytest.raises(TypeError, match="items: want one dtype"):
        type(item).stack([item, item.to(torch.float32)])
    with pytest.raises(ValueError, match="items: batch shapes do not broadcast"):
        type(item).stack([item, make(2)])


def test_cameras_that_differ_in_more_than_numbers_are_not_stacked() -> None:
    pinhole = camera()
    with pytest.raises(ValueError, match=r"items: want the same size, got \[\(640, 480\), None\]"):
        dp.Camera.stack([pinhole, dp.Camera(pinhole.K)])
    with pytest.raises(TypeError, match="items: want one kind of distortion, got BrownConrady, NoneType"):
        dp.Camera.stack([pinhole, camera(lens=brown())])
    with pytest.raises(ValueError, match="items: want distortions of one size"):
        dp.Camera.stack([camera(lens=dp.BrownConrady(torch.zeros(4, dtype=D))), camera(lens=brown())])
    points = draws(5, 3) + torch.tensor([0, 0, 9.0])
    both = dp.Camera.stack([camera(lens=brown()), camera(lens=dp.BrownConrady(torch.zeros(5, dtype=D)))])
    assert torch.equal(both.project(points)[0][0], camera(lens=brown()).project(points)[0])


@every
def test_pytree(make: Callable[..., Batched]) -> None:
    item = make(3)
    leaves, structure = tree_flatten(item)
    assert all(isinstance(leaf, Tensor) for leaf in leaves)
    assert same(tree_unflatten(leaves, structure), item)
    doubled = torch.utils._pytree.tree_map(lambda leaf: leaf, item)
    assert same(doubled, item)
    assert tree_unflatten([object()] * len(leaves), structure) is not None


@every
def test_vmap_runs_over_the_batch(make: Callable[..., Batched]) -> None:
    def inside(one: Any) -> Any:
        assert one.batch_shape == ()
        return one.detach().expand(2)

    item = make(3)
    assert inside(item[0] if not isinstance(item, dp.Views) else make()).batch_shape == (2,)
    assert torch.vmap(inside)(item).batch_shape == (3, 2)


@every
@pytest.mark.parametrize("again", [copy.deepcopy, lambda item: pickle.loads(pickle.dumps(item))])  # noqa: S301
def test_copies(make: Callable[..., Batched], again: Callable[[Any], Any]) -> None:
    item = make(3)
    assert same(again(item), item)


class Endless:
    """What can be asked for any element, and never ends."""

    def __getitem__(self, index: int) -> int:
        return index

    def __len__(self) -> int:
        return 3


def test_things_that_are_no_index_inside_of_an_index() -> None:
    """PyTorch reads any sequence number by number, and crashes where that never ends."""
    views = dp.example_views("left")
    cameras = dp.Camera(
        torch.eye(3, dtype=torch.float64).expand(13, 3, 3), distortion=dp.BrownConrady(torch.zeros(13, 4).double())
    )
    planes = dp.Plane.z(torch.zeros(13))
    wrong = [
        views,
        [views],
        [[views]],
        (0, views),
        [0, Endless()],
        Endless(),
        [None],
        [0.5],
        slice("a"),
        slice(views, None),
        {},
        b"x",
    ]
    for batch in (cameras, cameras.distortion, planes, views):
        for index in [*wrong, cameras, planes, torch.tensor(0.5), np.array(["a"]), np.array([0.5])]:
            with pytest.raises(
                TypeError, match=r"index: want numbers, slices, lists or masks, got .*; some of a batch is"
            ):
                batch[index]
        with pytest.raises(IndexError):
            batch[2**70]
    assert cameras[[0, 5]].batch_shape == (2,)
    assert (
        cameras[np.array([3, 1], dtype=np.uint16)].batch_shape == planes[[True] * 2 + [False] * 11].batch_shape == (2,)
    )


@pytest.mark.plain
def test_a_shape_that_the_batch_does_not_broadcast_to() -> None:
    planes = dp.Plane.z(torch.zeros(6))
    assert planes.expand(2, -1).batch_shape == planes.expand((2, 6)).batch_shape == (2, 6)
    for shape in ((5,), (), (-3, 6), (-1, 6), (6, 2)):
        with pytest.raises(ValueError, match=r"batch_shape: want one that \(6,\) broadcasts to, got"):
            planes.expand(*shape)
    with pytest.raises(ValueError, match="batch_shape: want at most 60 axes, got 70"):
        planes.expand(*[1] * 69, 6)
    with pytest.raises(TypeError, match="batch_shape: want whole numbers, got"):
        planes.expand("a")
    lens = dp.BrownConrady(torch.zeros(6, 4))
    with pytest.raises(ValueError, match="batch_shape"):
        lens.expand(5)


def test_deep_copies_of_results_of_a_computation() -> None:
    scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    K = scale * torch.tensor([[300.0, 0, 320], [0, 300, 240], [0, 0, 0.5]], dtype=torch.float64)
    lens = dp.BrownConrady(scale * torch.tensor([0.01, 0, 0, 0], dtype=torch.float64))
    camera = dp.Camera(K, t=torch.tensor([0.0, 0, 5], dtype=torch.float64), distortion=lens)
    pixels = torch.tensor([[100.0, 50], [300, 200]], dtype=torch.float64)
    plane = dp.Plane(scale * torch.tensor([0.0, 0, 1], dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64))
    for thing in (camera, lens, plane, dp.PlaneMap(camera, plane), dp.Views(K[None, :2, :2])):
        again = copy.deepcopy(thing)
        for old, new in zip(tree_leaves(thing), tree_leaves(again), strict=True):
            assert torch.equal(old, new)
            assert new.is_leaf
            assert old.data_ptr() != new.data_ptr()
    measured = dp.measure(pixels, camera, plane, pixel_sigma=0.5)
    again = copy.deepcopy({"measured": [measured]})["measured"][0]
    assert torch.equal(again.lengths().deviation, measured.lengths().deviation)
    assert again.points.is_leaf
    length = copy.deepcopy(measured.lengths())
    assert torch.equal(length.interval()[0], measured.lengths().interval()[0])


@pytest.mark.plain
def test_planes_of_points_are_no_list_to_be_stacked() -> None:
    planes = dp.Plane.per_point(torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    with pytest.raises(TypeError, match="^items: want several Camera, got"):
        dp.Camera.stack(planes)  # type: ignore[arg-type]
