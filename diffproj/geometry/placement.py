"""Where a camera stands, as other programs say it: projection matrices, 4 x 4 extrinsics, and "look at".

The axes of a camera frame, and how a 4 x 4 matrix acts:

    opencv       x right, y down, z forward      X_cam = M X_world, columns: ROS's optical frames, COLMAP, KITTI
    opengl       x right, y up, z backward       the same; Blender, NeRF, ARKit
    pytorch3d    x left, y up, z forward         X_cam = X_world M, rows: M as `Transform3d.get_matrix()` gives it
"""

import re
from typing import Literal, TypeVar, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, choice, meeting
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, dot, has_values, rounding
from diffproj.geometry.grid import checked_size
from diffproj.geometry.intrinsics import intrinsic_matrix
from diffproj.geometry.mounting import Mounted, Number, focal_lengths
from diffproj.lens.protocol import Lens

C = TypeVar("C", bound="Placed")

Convention = Literal["opencv", "opengl", "pytorch3d"]

_SIGNS: dict[str, tuple[float, float, float]] = {
    "opencv": (1.0, 1.0, 1.0),
    "opengl": (1.0, -1.0, -1.0),
    "pytorch3d": (-1.0, -1.0, 1.0),
}
"""From a convention's camera axes to ours."""

SKEW = 0.1
"""A skew of fewer than so many roots of the rounding error, relative to f_x, is rounding."""


class Placed(Mounted):
    """Cameras from and to matrices that say where they stand."""

    __slots__ = ()

    @classmethod
    def from_matrix(
        cls: type[C],
        projection: Float[Tensor, "*batch _ 4"] | Array,
        size: tuple[int, int] | None = None,
    ) -> C:
        """A pinhole from a matrix that takes points of the world to pixels, such as KITTI's `P2` or `lidar2img`.

        Args:
            projection: `(*B, 3, 4)`, `K [R | t]` up to a factor, or `(*B, 4, 4)` with the last row (0, 0, 0, 1).
                Gradients flow to it.
            size: image size `(width, height)` in px.

        The focal lengths are positive: a matrix alone does not tell a mirrored image from a camera that is turned.

        Raises:
            TypeError: no floating-point tensor or array.
            ValueError: wrong shapes, values that are not finite, or no perspective camera.

        Example:
            >>> import diffproj as dp
            >>> P2 = [[721.5, 0.0, 609.6, 44.9], [0.0, 721.5, 172.9, 0.2], [0.0, 0.0, 1.0, 0.003]]
            >>> dp.Camera.from_matrix(P2, size=(1242, 375))
            Camera(f 721.5, 721.5 px, c 609.6, 172.9 px, pinhole, 1242 x 375 px, torch.float64)
        """
        P = check_tensor("projection", projection, "3 or 4", 4)
        P = _three_rows("projection", P)
        if has_values(P):
            if not bool(P.isfinite().all()):
                raise ValueError("projection: want finite values, got NaN or infinity")
            P = P / P[..., :3].detach().abs().amax((-2, -1)).clamp_min(torch.finfo(P.dtype).tiny)[..., None, None]
            if not bool((torch.linalg.det(P[..., :3]).abs() > 1e-12).all() and P.isfinite().all()):
                raise ValueError("projection: want K [R | t] of a perspective camera, got a matrix without inverse")
        third = P[..., 2, :3].norm(dim=-1)
        sign = torch.where(torch.linalg.det(P[..., :3] / third[..., None, None].detach()) < 0, -1.0, 1.0)
        P = P * (sign / third)[..., None, None]
        first, second, forward = P[..., :3].unbind(-2)
        c_x, c_y = dot(first, forward), dot(second, forward)
        down = second - c_y.unsqueeze(-1) * forward
        f_y = down.norm(dim=-1)
        down = down / f_y.unsqueeze(-1)
        skew = dot(first, down)
        right = first - c_x.unsqueeze(-1) * forward - skew.unsqueeze(-1) * down
        f_x = right.norm(dim=-1)
        R = torch.stack([right / f_x.unsqueeze(-1), down, forward], dim=-2)
        skew = torch.where(skew.abs() <= SKEW * torch.finfo(P.dtype).eps ** 0.5 * f_x, 0.0, skew)
        K = intrinsic_matrix(torch.stack([f_x, f_y], dim=-1), torch.stack([c_x, c_y], dim=-1))
        K = K + torch.nn.functional.pad(skew[..., None, None], (1, 1, 0, 2))
        x, y, z = P[..., 3].unbind(-1)
        t_y = (y - c_y * z) / f_y
        t = torch.stack([(x - c_x * z - skew * t_y) / f_x, t_y, z], dim=-1)
        if has_values(P) and not bool(K.isfinite().all() and t.isfinite().all()):
            raise ValueError("projection: want K [R | t] of a perspective camera, got one that is infinitely far away")
        return cls(K, R, t, None, size)  # type: ignore[call-arg]

    @classmethod
    def from_extrinsics(
        cls: type[C],
        extrinsics: Float[Tensor, "*#batch _ 4"] | Array,
        K: Float[Tensor, "*#batch 3 3"] | Array,
        convention: Convention = "opencv",
        to: Literal["camera", "world"] = "camera",
        distortion: Lens | None = None,
        size: tuple[int, int] | None = None,
    ) -> C:
        """A camera from a 4 x 4 matrix between world and camera.

        A camera-to-world matrix that is taken for a world-to-camera one is the classic silent mistake: everything goes
        on working, with points somewhere else. The test to make: `camera.center` is where the camera stands, and
        `camera.project` of a point that the photograph shows is where the photograph shows it.

        Args:
            extrinsics: `(*B, 4, 4)`, or `(*B, 3, 4)` without the last row. Gradients flow to it.
            K: intrinsics `(*B, 3, 3)`.
            convention: of the camera's axes, and of how the matrix acts: `"opencv"` (x right, y down, z forward),
                `"opengl"` (x right, y up, z backward: Blender, NeRF) or `"pytorch3d"` (x left, y up, z forward, and the
                matrix acting on rows, as `Transform3d.get_matrix()` gives it).
            to: what the matrix leads to: `"camera"` (world to camera) or `"world"` (camera to world).
            distortion: the lens.
            size: image size `(width, height)` in px.

        Raises:
            TypeError: no floating-point tensors or arrays, or mixed dtypes.
            ValueError: an unknown word, wrong shapes, a part that is no rotation, or a last row other than
                (0, 0, 0, 1).

        Example:
            A camera of Blender, which stands 5 above the origin and looks down along its own -z.

            >>> import diffproj as dp
            >>> blender = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]
            >>> K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
            >>> camera = dp.Camera.from_extrinsics(blender, K, convention="opengl", to="world")
            >>> camera.center[2].item(), camera.project([[1.0, 0.5, 0.0]])[0].tolist()
            (5.0, [[420.0, 190.0]])
        """
        convention = choice("convention", convention, get_args(Convention))  # type: ignore[assignment]
        to = choice("to", to, ("camera", "world"))  # type: ignore[assignment]
        like = next((one for one in (extrinsics, K) if isinstance(one, Tensor)), meeting(distortion))
        K = check_tensor("K", K, 3, 3, like=like)
        matrix = check_tensor("extrinsics", extrinsics, "3 or 4", 4, like=K)
        if convention == "pytorch3d":
            matrix = matrix.mT
        matrix = _three_rows("extrinsics", matrix)
        R, t = matrix[..., :3], matrix[..., 3]
        if to == "world":
            R, t = R.mT, -dot(R.mT, t.unsqueeze(-2))
        signs = R.new_tensor(_SIGNS[convention])
        try:
            return cls(K, signs.unsqueeze(-1) * R, signs * t, distortion, size)  # type: ignore[call-arg]
        except ValueError as error:
            raise ValueError(re.sub("^[Rt]:", "extrinsics:", str(error))) from None

    def world_to_cam(self, convention: Convention = "opencv") -> Float[Tensor, "*batch 4 4"]:
        """The matrix from the world to the camera, as `from_extrinsics(..., to="camera")` takes it.

        Args:
            convention: as for `from_extrinsics`.

        Raises:
            TypeError: no word.
            ValueError: an unknown one.

        Example:
            >>> import diffproj as dp
            >>> camera = dp.Camera(torch.eye(3), t=torch.tensor([0.0, 0, 5]))
            >>> camera.world_to_cam()[:3, 3].tolist(), camera.world_to_cam("opengl")[2, 3].item()
            ([0.0, 0.0, 5.0], -5.0)
        """
        convention = choice("convention", convention, get_args(Convention))  # type: ignore[assignment]
        signs = self.R.new_tensor(_SIGNS[convention])
        matrix = _four_rows(signs.unsqueeze(-1) * self.R, signs * self.t)
        return matrix.mT if convention == "pytorch3d" else matrix

    def cam_to_world(self, convention: Convention = "opencv") -> Float[Tensor, "*batch 4 4"]:
        """The matrix from the camera to the world, as `from_extrinsics(..., to="world")` takes it.

        Args:
            convention: as for `from_extrinsics`.

        Raises:
            TypeError: no word.
            ValueError: an unknown one.
        """
        convention = choice("convention", convention, get_args(Convention))  # type: ignore[assignment]
        signs = self.R.new_tensor(_SIGNS[convention])
        center = -dot(self.R.mT, self.t.unsqueeze(-2))
        matrix = _four_rows(self.R.mT * signs, center)
        return matrix.mT if convention == "pytorch3d" else matrix

    @classmethod
    def looking_at(
        cls: type[C],
        position: Float[Tensor, "*#batch 3"] | Array,
        target: Float[Tensor, "*#batch 3"] | Array,
        up: Float[Tensor, "*#batch 3"] | Array = (0.0, 0.0, 1.0),
        *,
        size: tuple[int, int],
        focal: Number | tuple[Number, Number] | None = None,
        fov_deg: Number | None = None,
        principal_point: Float[Tensor, "*#batch 2"] | Array | None = None,
        distortion: Lens | None = None,
    ) -> C:
        """A camera that stands somewhere and looks at something: no matrix that could be the wrong way round.

        Args:
            position: of the centre of projection in the world `(*B, 3)`.
            target: the point in the world that its optical axis meets `(*B, 3)`.
            up: the direction in the world that points up in the picture `(*B, 3)`.
            size: image size `(width, height)` in px.
            focal: focal length in px; a tuple `(f_x, f_y)` where they differ.
            fov_deg: in the place of it, the horizontal field of view from edge to edge.
            principal_point: `(*B, 2)` in px; the middle of the image if left out.
            distortion: the lens.

        Raises:
            TypeError: not numbers, or tensors of mixed dtypes.
            ValueError: position and target are one point, or the camera looks along `up`; none or both of the focal
                lengths; or shapes that do not broadcast.

        Example:
            >>> import diffproj as dp
            >>> camera = dp.Camera.looking_at([0.0, -4.0, 3.0], [0.0, 0.0, 0.0], focal=500.0, size=(641, 481))
            >>> camera.project([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])[0].round().tolist()
            [[320.0, 240.0], [420.0, 240.0]]
        """
        sides = checked_size(size)
        if sides is None:
            raise TypeError("size: want (width, height) of the image in px, got None")
        given = (position, target, up, focal, fov_deg, principal_point)
        kind = meeting(*(one for one in given if isinstance(one, Tensor)), distortion)
        kind = torch.empty(0, dtype=torch.float64, device="cpu") if kind is None else kind
        position, target, up = (
            check_tensor(name, value, 3, like=kind)
            for name, value in (("position", position), ("target", target), ("up", up))
        )
        middle = [(side - 1) / 2 for side in sides] if principal_point is None else principal_point
        center = check_tensor("principal_point", middle, 2, like=kind)
        if has_values(center) and not bool(center.isfinite().all()):
            raise ValueError("principal_point: want finite numbers, got NaN or infinity")
        f_x, f_y = focal_lengths(sides, kind, focal, fov_deg, None, None)
        check_same_kind(position=position, target=target, up=up, principal_point=center, focal=f_x)
        batch = broadcast_batches(
            position=position.shape[:-1],
            target=target.shape[:-1],
            up=up.shape[:-1],
            principal_point=center.shape[:-1],
            focal=f_x.shape,
            focal_y=f_y.shape,
        )
        ahead = (target - position).expand(*batch, 3)
        right = torch.linalg.cross(ahead, up.expand(*batch, 3), dim=-1)
        if has_values(right):
            if not bool(position.isfinite().all() & target.isfinite().all() & up.isfinite().all()):
                raise ValueError("position, target, up: want finite numbers, got NaN or infinity")
            reach = ahead.norm(dim=-1) * up.norm(dim=-1)
            if not bool((right.norm(dim=-1) > rounding(kind.dtype) * reach).all()):
                raise ValueError("up: want a direction other than that from position to target, got one along it")
        ahead, right = (torch.nn.functional.normalize(axis, dim=-1) for axis in (ahead, right))
        R = torch.stack([right, torch.linalg.cross(ahead, right, dim=-1), ahead], dim=-2)
        focals = torch.stack(torch.broadcast_tensors(f_x, f_y), dim=-1)
        K = intrinsic_matrix(focals.expand(*batch, 2), center.expand(*batch, 2))
        return cls(K, R, -dot(R, position.expand(*batch, 3).unsqueeze(-2)), distortion, sides)  # type: ignore[call-arg]


def _three_rows(name: str, matrix: Tensor) -> Tensor:
    """The first three rows `(*B, 3, 4)` of a matrix of three or four.

    Raises:
        ValueError: another number, or a fourth row that is not (0, 0, 0, 1).
    """
    if matrix.shape[-2:] not in ((3, 4), (4, 4)):
        raise ValueError(f"{name}: want shape (*B, 3, 4) or (*B, 4, 4), got {tuple(matrix.shape)}")
    if matrix.shape[-2] == 4 and has_values(matrix):
        last = matrix.new_tensor([0.0, 0, 0, 1])
        if not bool(((matrix[..., 3, :] - last).abs() <= 1e-6).all()):
            raise ValueError(
                f"{name}: want the last row (0, 0, 0, 1), got {matrix[..., 3, :].reshape(-1, 4)[0].tolist()}; "
                "a matrix that acts on rows is transposed: .mT (and PyTorch3D's are taken as they are)"
            )
    return matrix[..., :3, :]


def _four_rows(R: Tensor, t: Tensor) -> Tensor:
    last = R.new_tensor([0.0, 0, 0, 1]).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t.unsqueeze(-1)], dim=-1), last], dim=-2)
