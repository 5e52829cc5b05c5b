"""Top views with a number of samples that is said depend on no values: one graph, and an exported program."""

import pytest
import torch

import diffproj as dp

EXTENT = (-100.0, -100.0, 100.0, 100.0)


@pytest.mark.parametrize("behind_lens", [False, True])
def test_one_graph_gives_what_eager_gives(behind_lens: bool) -> None:
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    R = dp.rotation_from_euler(*torch.tensor([0.3, 0.2, 0.1]))
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002])) if behind_lens else None
    camera = dp.Camera(K, R, torch.tensor([0.0, 0, 1000]), lens, size=(640, 480))
    plane, image = dp.Plane.z(0.0), torch.rand(1, 480, 640)

    def above(image: torch.Tensor, camera: dp.Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return dp.rectify(image, camera, plane, EXTENT, 2.0, samples=1)

    def back(image: torch.Tensor, camera: dp.Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return dp.render(image, camera, plane, EXTENT, size=(64, 48), samples=2)

    for call in (above, back):
        want, valid = call(image, camera)
        got, seen = torch.compile(call, fullgraph=True)(image, camera)
        torch.testing.assert_close(got, want, rtol=0, atol=2e-4)
        assert torch.equal(seen, valid)

    class FromAbove(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            return above(image, camera)[0]

    program = torch.export.export(FromAbove(), (image,))
    torch.testing.assert_close(program.module()(image), above(image, camera)[0], rtol=0, atol=2e-4)


class Tops(torch.nn.Module):
    """Top views of extents that are an input."""

    def __init__(self, camera: dp.Camera) -> None:
        super().__init__()
        self.camera = camera

    def forward(self, images: torch.Tensor, extents: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return dp.rectify(images, self.camera, dp.Plane.z(0.0), extents, size=(40, 30), samples=(1, 2))


@pytest.mark.parametrize("behind_lens", [False, True])
def test_extents_of_each_image_are_an_input_of_the_graph(behind_lens: bool) -> None:
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002])) if behind_lens else None
    tops = Tops(dp.Camera(K, None, torch.tensor([0.0, 0, 1000]), lens, size=(640, 480)))
    extents = torch.tensor([[-100.0, -100, 100, 100], [-50, 0, 150, 90], [0, 0, 300, 200]])
    images = torch.rand(3, 1, 480, 640)
    want, valid = tops(images, extents)
    once, _ = dp.rectify(images[1], tops.camera, dp.Plane.z(0.0), extents[1].tolist(), size=(40, 30), samples=(1, 2))
    torch.testing.assert_close(want[1], once, rtol=0, atol=1e-4)
    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(tops, (images, extents), dynamic_shapes=({0: batch}, {0: batch}))
    for call in (torch.compile(tops, fullgraph=True), program.module()):
        got, seen = call(images, extents)
        torch.testing.assert_close(got, want, rtol=0, atol=2e-4)
        assert torch.equal(seen, valid)
    two, _ = program.module()(images[:2], extents[:2])
    torch.testing.assert_close(two, want[:2], rtol=0, atol=2e-4)


def test_a_resolution_needs_extents_that_can_be_read() -> None:
    camera = dp.Camera(torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), size=(640, 480))
    with pytest.raises(Exception, match=r"size: want the top view's \(width, height\)"):
        torch.compile(lambda extents: dp.rectify(torch.rand(2, 1, 480, 640), camera, dp.Plane.z(9.0), extents, 1.0))(
            torch.tensor([[0.0, 0, 3, 2], [1, 1, 4, 3]])
        )
