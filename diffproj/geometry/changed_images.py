"""What becomes of a camera when its image is resized, cropped or warped: the part of `Camera` that is about images."""

from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, flag, number, whole_number
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, dot, has_values
from diffproj.geometry.camera_parts import CameraParts
from diffproj.geometry.grid import checked_size
from diffproj.geometry.intrinsics import check_warp, warped

C = TypeVar("C", bound="ChangedImages")

ROUNDED_ASPECT = 1.1
"""Factor by which rounding to whole pixels may change the aspect of an image."""


class ChangedImages(CameraParts):
    """Cameras of the same image, resized, cropped or warped."""

    __slots__ = ()

    def resized(self: C, size: tuple[int, int], stretched: bool = False) -> C:
        """The camera of the same image resized to `size = (width, height)`: `c -> s c + (s - 1) / 2`.

        Each axis has its own scale, so that sides rounded to whole pixels stay exact.

        Args:
            size: `(width, height)` of the resized image, its aspect that of the camera's to within a pixel, and a
                tenth.
            stretched: whether the whole image was stretched to another aspect, as networks of a fixed input size do.

        Raises:
            TypeError: the size is not two whole numbers.
            ValueError: the camera does not know its own size, or another aspect. A camera's video mode of another
                aspect shows a part of the sensor: crop first.

        Example:
            >>> import torch, diffproj as dp
            >>> camera = dp.Camera(torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]), size=(640, 480))
            >>> wide = camera.cropped(0, 60, 640, 360).resized((1280, 720))  # 16 : 9, cut from 4 : 3
            >>> wide.K.tolist()
            [[1000.0, 0.0, 639.5], [0.0, 1000.0, 359.5], [0.0, 0.0, 1.0]]
        """
        stretched = flag("stretched", stretched)
        if self.size is None:
            raise ValueError(
                "resized: want a camera with a size, got size=None; give Camera(..., size=(width, height))"
            )
        if size is None:
            raise TypeError("size: want (width, height) of the resized image, got None")
        width, height = checked_size(size) or self.size
        scale = (width / self.size[0], height / self.size[1])
        # Rounding moves each side by a pixel at most: is there one scale that both may have been rounded from?
        # Of a few pixels it would leave no aspect at all: there is a limit to what it may change.
        rounded = abs(scale[0] - scale[1]) <= 1 / self.size[0] + 1 / self.size[1]
        if not (rounded and max(scale) <= ROUNDED_ASPECT * min(scale)) and not stretched:
            raise ValueError(
                f"resized: want the aspect of {self.size[0]} x {self.size[1]} px, got {width} x {height}; where the "
                "image shows a part of the camera's, use cropped(left, top, width, height) first; where all of it was "
                "stretched, resized(size, stretched=True)"
            )
        factors = self.K.new_tensor([[scale[0]], [scale[1]], [1.0]])
        shift = self.K.new_tensor([[0, 0, (scale[0] - 1) / 2], [0, 0, (scale[1] - 1) / 2], [0, 0, 0]])
        return self._with(K=self.K * factors + shift, size=(width, height))

    def cropped(self: C, left: float, top: float, width: int, height: int) -> C:
        """The camera of the crop whose first pixel was pixel `(left, top)`: the principal point moves along.

        Raises:
            TypeError: `left` or `top` is no number, or width and height are not whole.
            ValueError: `left` or `top` is not finite, or width or height is not positive.
        """
        left, top = (number(name, side, "a finite number of px") for name, side in (("left", left), ("top", top)))
        width, height = (whole_number(name, side, least=1) for name, side in (("width", width), ("height", height)))
        shift = self.K.new_tensor([[0, 0, left], [0, 0, top], [0, 0, 0]])
        return self._with(K=self.K - shift, size=checked_size((width, height)))

    def warped(self: C, matrix: Float[Tensor, "*#batch 3 3"] | Array, size: tuple[int, int] | None = None) -> C:
        """The camera of the same image warped, as a geometric augmentation does: pixels `p` go to `matrix p`.

        An affine matrix changes K alone: turned, mirrored, sheared, scaled and shifted images stay exact, behind a lens
        too. A projective one also turns a pinhole, so that the middle of the image (the principal point, where the
        camera has no size) stays in front of it. Gradients flow to the matrix.

        Args:
            matrix: `(*B, 3, 3)`, from pixels `(u, v, 1)` of this image to those of the warped one, up to a factor;
                what Kornia's augmentations keep as `transform_matrix`.
            size: `(width, height)` of the warped image; that of this one if left out.

        Raises:
            TypeError: no floating-point tensor, or another dtype than the camera's.
            ValueError: wrong shape or device, no inverse, or a projective matrix for a camera with a lens, for which
                no lens model describes the warped image. Values are checked where they can be read, not while
                compiling or under `vmap`.

        Example:
            >>> import torch, diffproj as dp
            >>> from kornia.augmentation import RandomHorizontalFlip
            >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
            >>> camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), size=(640, 480))
            >>> flip = RandomHorizontalFlip(p=1.0)
            >>> image = flip(torch.rand(1, 3, 480, 640))
            >>> pixels, _ = camera.warped(flip.transform_matrix).project(torch.tensor([[100.0, 0, 0]]))
            >>> pixels.tolist()  # 639 - 370
            [[[269.0, 240.0]]]
        """
        return self.warped_by("matrix", matrix, size)

    def warped_by(
        self: C, name: str, matrix: Float[Tensor, "*#batch 3 3"] | Array, size: tuple[int, int] | None = None
    ) -> C:
        """The same, for an argument of that name."""
        matrix = check_tensor(name, matrix, 3, 3, like=self.K)
        check_same_kind(**{"camera": self.K, name: matrix})
        broadcast_batches(**{"camera": self.batch_shape, name: matrix.shape[:-2]})
        if has_values(matrix):
            check_warp(name, matrix, self.K, behind_lens=self.distortion is not None)
        ahead = None if self.size is None else [(side - 1) / 2 for side in self.size]
        K, turn = warped(self.K, matrix, ahead)
        if turn is None:
            return self._with(K=K, size=checked_size(size) or self.size)
        R, t = (turn.unsqueeze(-1) * self.R.unsqueeze(-3)).sum(-2), dot(turn, self.t.unsqueeze(-2))
        return self._with(K=K, R=R, t=t, size=checked_size(size) or self.size)
