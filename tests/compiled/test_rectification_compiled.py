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
