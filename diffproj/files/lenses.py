"""Lenses by the names that files give them; what is no lens of this package is refused by name.

Equal to Brown-Conrady or to Kannala-Brandt are only those named here: under other names stand other equations.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal

from diffproj.files.numbers import as_tensor, number
from diffproj.geometry.camera import Camera
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt

Kind = Literal["none", "brown", "fisheye"]

_BROWN = (
    *("plumb_bob", "radtan", "radial_tangential", "brown", "brown_conrady", "rational_polynomial", "rational"),
    *("brown4", "brown5", "brown8", "brown12", "brown14", "opencv", "opencv4", "opencv5", "opencv8", "full_opencv"),
    "rectilinear",  # of calibdb.net, beside OpenCV's five
)
_FISHEYE = (
    "equidistant",
    "fisheye",
    "kannala_brandt",
    "kannala_brandt4",
    "kannala_brandt8",
    "kb4",
    "kannalabrandt8",
    "equi",
    "opencv_fisheye",
)
KINDS_BY_NAME: dict[str, Kind] = {
    **dict.fromkeys(("none", "simple_pinhole"), "none"),
    **dict.fromkeys(_BROWN, "brown"),
    **dict.fromkeys(_FISHEYE, "fisheye"),
}
"""What a lens of a file is here; the names in lower case, with `_` between words."""

PERSPECTIVE = ("pinhole", "perspective", "standard", "frame", "normal", "monocular", "mono")
"""Names of cameras that tell nothing of the lens but that it is no fisheye."""

COUNTS = BrownConrady.counts


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


MODELS = _words(
    "distortionmodel cameramodel modeltype lensmodel fisheyemodel fisheye isfisheye distortiontype cameratype"
)
"""Keys that tell the lens, in lower case without what stands between words."""

LOOSE = _words("cameratype model type lenstype projection projectiontype projectionmodel")
"""Keys that may tell the lens, or what the camera is called or for: heeded where they name a lens, of whatever kind."""

_LENS = re.compile(
    r"fish ?eye|\bomni(?!vision)|\bequi(dist|rect|sol|$)|spherical|panoram|orthograph|stereograph|eucm|inverse"
    r"|\bf ?theta|double sphere|division|^(mei|fov\d?|ds)$"
)
"""What names a lens, and makers hardly use; a camera whose name holds it, as "Fisheye Cam", is refused."""


def kind_of(name: str, value: object) -> Kind | None:
    """Which lens a file's model is; `None` where it says no more than that the camera is perspective.

    Args:
        name: of the key, for the message.
        value: what the file says.

    Raises:
        ValueError: a model that is none of this package's.
    """
    if isinstance(value, bool | int | float) and value in (0, 1):  # fisheye_model: 0
        return "fisheye" if value else "brown"
    model = _plain(value)
    if model in PERSPECTIVE:
        return None
    if model not in KINDS_BY_NAME:
        raise ValueError(
            f"{name}: want a model equal to OpenCV's perspective or fisheye one, got {value!r}, which is neither; "
            "calibrate again with one of them"
        )
    return KINDS_BY_NAME[model]


def told(fields: dict[str, Any], read: Iterable[str] = ()) -> dict[Kind, str]:
    """Which lenses the keys of a mapping name, with the key that does so; see `MODELS` and `LOOSE`.

    Args:
        fields: the mapping.
        read: keys that are read otherwise.

    Raises:
        ValueError: a model that is none of this package's.
    """
    kinds: dict[Kind, str] = {}
    for key, value in fields.items():
        plain = re.sub(r"[^a-z0-9]", "", key.lower())
        if key in read or plain not in MODELS | LOOSE or value is None or value == "":
            continue
        if plain in LOOSE and not _names_lens(value, numbers=plain in MODELS):
            continue
        try:
            kind = kind_of(key, value)
        except ValueError as error:
            remedy = f", or take {key} out where it is what the camera is called" if plain in LOOSE else ""
            raise ValueError(f"{error}{remedy}") from None
        if kind is not None:
            kinds[kind] = key
    return kinds


def _names_lens(value: object, numbers: bool) -> bool:
    """Whether a value under a loose key is the name of a lens, or its number where the key may have one."""
    if not isinstance(value, str):
        return numbers
    model = _plain(value)
    return model != "none" and (model in KINDS_BY_NAME or _LENS.search(model.replace("_", " ")) is not None)


def _plain(value: object) -> str:
    """The name of a model in lower case, with `_` between words."""
    return str(value).strip().lower().replace("-", "_").replace(" ", "_")


def brown(coefficients: Sequence[float]) -> BrownConrady:
    """A Brown-Conrady lens of 4, 5, 8, 12 or 14 coefficients in OpenCV's order."""
    return BrownConrady(as_tensor(coefficients))


def fisheye(coefficients: Sequence[float]) -> KannalaBrandt:
    """A Kannala-Brandt lens of k1 to k4."""
    return KannalaBrandt(as_tensor(coefficients))


def lens_of(kind: Kind, coefficients: Sequence[float]) -> BrownConrady | KannalaBrandt | None:
    """The lens of that kind; of no coefficients, a pinhole.

    Raises:
        ValueError: the kind has another number of coefficients.
    """
    if kind == "fisheye":
        if len(coefficients) != 4:
            raise ValueError(f"distortion: want the 4 coefficients of a fisheye lens, got {len(coefficients)}")
        return fisheye(coefficients)
    if not coefficients:
        return None
    if kind == "none" and any(coefficients):
        raise ValueError(f"distortion: want no coefficients as the model says, got {list(coefficients)}")
    if len(coefficients) not in COUNTS:
        raise ValueError(f"distortion: want {', '.join(map(str, COUNTS))} coefficients, got {len(coefficients)}")
    return brown(coefficients)


def unused(name: str, value: object, why: str) -> None:
    """Check that a coefficient which the lenses of this package lack is 0.

    Raises:
        ValueError: it is not.
    """
    if value is not None and number(name, value) != 0:
        raise ValueError(f"{name}: want 0, got {value}: {why}")


def coefficients(camera: Camera) -> list[float]:
    """The coefficients of one camera's lens; empty of a pinhole.

    Raises:
        ValueError: a lens of another package.
    """
    lens = camera.distortion
    if lens is not None and type(lens) not in (BrownConrady, KannalaBrandt):
        raise ValueError(f"distortion: want a BrownConrady or KannalaBrandt lens, got {type(lens).__name__}")
    return [] if lens is None else lens.coefficients.tolist()  # type: ignore[attr-defined]


def is_fisheye(camera: Camera) -> bool:
    """Whether the lens is Kannala-Brandt."""
    return isinstance(camera.distortion, KannalaBrandt)


def first_brown(camera: Camera, count: int, what: str) -> list[float]:
    """The first coefficients of a perspective lens, filled up with 0, where the others are 0.

    Raises:
        ValueError: one of the others is not 0, so that `what` cannot hold the lens.
    """
    found = coefficients(camera)
    if is_fisheye(camera) or any(found[count:]):
        kind = "a fisheye lens" if is_fisheye(camera) else f"coefficients beyond the first {count}"
        raise ValueError(f"distortion: want a lens that {what} holds, got {kind}")
    return [*found, *[0.0] * (count - len(found))][:count]
