"""The lens models by name: which class each is, how many coefficients it has, and what they are called.

Whatever fits, learns, prints or stores a lens looks it up here. A model of the package is a `CoefficientLens`; a lens
of another package needs no entry, only what `Lens` asks for, and `register_lens` where transformations carry it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar, get_args

import torch.utils._pytree as torch_pytree
from torch import Tensor

from diffproj._core.arguments import called, instance, words
from diffproj._core.batched import register_pytree
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.kannala_brandt import KannalaBrandt
from diffproj.lens.names import LensModel
from diffproj.lens.protocol import Lens

T = TypeVar("T")
DENOMINATOR = ("k4", "k5", "k6")
"""The terms below the line of a rational lens."""


@dataclass(frozen=True)
class Model:
    """A lens model.

    Attributes:
        name: what users call it.
        kind: the class of its lenses, `None` for a pinhole.
        coefficient_names: in the order of the class.
        perspective: whether it sees only what is in front of the camera, at z > 0.
    """

    name: LensModel
    kind: type[CoefficientLens] | None
    coefficient_names: tuple[str, ...]
    perspective: bool = True

    @property
    def count(self) -> int:
        """The number of coefficients."""
        return len(self.coefficient_names)

    @property
    def below(self) -> tuple[str, ...]:
        """The terms below the line of a rational lens, by name; of another lens none (a fisheye's k4 is another)."""
        return tuple(name for name in DENOMINATOR if name in self.coefficient_names) if self.perspective else ()

    def lens(self, coefficients: Tensor) -> CoefficientLens | None:
        """The lens with coefficients `(*B, count)`, without a look at their values."""
        return None if self.kind is None else self.kind.unchecked(coefficients)


_BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")

_MODELS = (
    Model("none", None, ()),
    *(Model(f"brown{count}", BrownConrady, _BROWN_CONRADY[:count]) for count in BrownConrady.counts),  # type: ignore[arg-type]
    Model("fisheye", KannalaBrandt, ("k1", "k2", "k3", "k4"), perspective=False),
)
MODELS: dict[LensModel, Model] = {model.name: model for model in _MODELS}
KINDS: dict[str, type[CoefficientLens]] = {model.kind.__name__: model.kind for model in _MODELS if model.kind}
"""The classes by their names, as camera files call them."""


def model_named(name: object) -> Model:
    """The model of a name.

    Raises:
        ValueError: there is none.
    """
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"distortion: want one of {', '.join(get_args(LensModel))}, got {called(name)}")
    return MODELS[name]  # type: ignore[index]


def model_of(lens: object) -> Model:
    """The model of a camera's lens.

    Raises:
        TypeError: it is a lens of another package.
    """
    if lens is None:
        return MODELS["none"]
    if isinstance(lens, CoefficientLens):
        for model in _MODELS:
            if type(lens) is model.kind and lens.coefficients.shape[-1] == model.count:
                return model
    raise TypeError(f"camera: want a pinhole, dp.BrownConrady or dp.KannalaBrandt lens, got {type(lens).__name__}")


def coefficients_of(lens: Lens | None, like: Tensor) -> Tensor:
    """The coefficients `(*B, k)` of a lens of the package; `(*B, 0)` of none, with the batch axes of `like (*B, n)`.

    Raises:
        TypeError: it is a lens of another package.
    """
    model_of(lens)
    return like[..., :0] if lens is None else lens.coefficients  # type: ignore[union-attr]


def register_lens(kind: type[T], tensors: Sequence[str], constants: Sequence[str] = ()) -> type[T]:
    """Let `vmap`, `torch.func`, `torch.compile` and `torch.export` carry a lens of another package.

    A camera takes any lens that offers what `Lens` asks for. To go through a transformation along with its camera, it
    has to be known as a PyTree; this makes it one, once, right behind the class. Inside a transformation an instance is
    rebuilt without its constructor: the attributes named here are all that it keeps.

    Args:
        kind: the class.
        tensors: names of the attributes that hold its tensors, batch axes in front.
        constants: names of other attributes, comparable with `==`.

    Returns:
        The class.

    Raises:
        TypeError: it is no class, or lacks something that `Lens` asks for; or names that are no strings.
        ValueError: it was registered before.

    Example:
        >>> import torch, diffproj as dp
        >>> class Stretched(dp.Lens):
        ...     '''x is stretched by a factor, y is not.'''
        ...     def __init__(self, factor):
        ...         self.factor = factor  # (*B,)
        ...     batch_shape = property(lambda self: self.factor.shape)
        ...     dtype = property(lambda self: self.factor.dtype)
        ...     device = property(lambda self: self.factor.device)
        ...     domain = property(lambda self: torch.full_like(self.factor, torch.inf))
        ...     def project_direction(self, direction):
        ...         valid = direction[..., 2] > 0
        ...         xy = direction[..., :2] / torch.where(valid, direction[..., 2], 1.0).unsqueeze(-1)
        ...         xy = torch.stack([xy[..., 0] * self.factor.unsqueeze(-1), xy[..., 1]], dim=-1)
        ...         return torch.where(valid.unsqueeze(-1), xy, 0.0), valid
        ...     def unproject(self, xy):
        ...         x = xy[..., 0] / self.factor.unsqueeze(-1)
        ...         return torch.stack([x, xy[..., 1], torch.ones_like(x)], dim=-1), xy.isfinite().all(-1)
        ...     def to(self, *args, **kwargs):
        ...         return Stretched(self.factor.to(*args, **kwargs))
        ...     def expand(self, *batch_shape):
        ...         return Stretched(self.factor.expand(batch_shape))
        ...     def detach(self):
        ...         return Stretched(self.factor.detach())
        ...     def __getitem__(self, index):
        ...         return Stretched(self.factor[index])
        >>> _ = dp.register_lens(Stretched, tensors=("factor",))
        >>> cameras = dp.Camera(torch.eye(3).expand(2, 3, 3), distortion=Stretched(torch.tensor([1.0, 2.0])))
        >>> torch.vmap(lambda camera: camera.project(torch.tensor([[1.0, 1.0, 2.0]]))[0])(cameras).tolist()
        [[[0.5, 0.5]], [[1.0, 0.5]]]
    """
    instance("kind", kind, type, "a class")
    tensors, constants = words("tensors", tensors, "several names"), words("constants", constants, "several names")
    lacking = [name for name in _MEMBERS if not hasattr(kind, name)]
    if lacking:
        raise TypeError(f"kind: want a lens, got {kind.__name__} without {', '.join(lacking)}; see dp.Lens")
    if kind in torch_pytree.SUPPORTED_NODES:
        raise ValueError(f"kind: want a class that is not registered yet, got {kind.__name__}")

    def build(**fields: object) -> T:
        lens = kind.__new__(kind)
        for name, value in fields.items():
            object.__setattr__(lens, name, value)
        return lens

    return register_pytree(kind, children=tensors, constants=constants, build=build)


_BROUGHT_ALONG = ("distort", "undistort")
"""What a lens may leave out, for no camera calls it: see `Lens`."""
_MEMBERS = (*(name for name in vars(Lens) if not name.startswith("_") and name not in _BROUGHT_ALONG), "__getitem__")
