"""Degrees of latitude and longitude to metres and back, by pyproj.

Cameras are measured in metres on a flat ground. A map projection, a UTM zone if no other is said, makes them of
degrees: x east, y north, within 0.1 % of true lengths. Heights are handed on as they are, above whatever they were
measured from. pyproj comes with `pip install 'diffproj[maps]'`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called, first_of
from diffproj._core.numerics import check_tensor

WGS84 = "EPSG:4326"
STRETCHED = 0.05
"""The part by which a map may stretch lengths; more is a map far from the points, or one such as Web Mercator."""


def metres_from_degrees(
    degrees: Float[Tensor, "*batch n d"] | Array, crs: str | None = None
) -> tuple[Float[Tensor, "*batch n d"], str]:
    """Metres east and north of latitudes and longitudes of WGS 84, as GPS has them.

    Args:
        degrees: `(*B, N, 2)` or with heights `(*B, N, 3)`: latitude, to the north, then longitude, to the east.
        crs: the map's coordinate reference system, such as `"EPSG:32630"`; the UTM zone of the points' middle if left
            out.

    Returns:
        The points `(*B, N, 2)` or `(*B, N, 3)`, east, north, and the heights as they were, in float64; and the
        coordinate reference system. East and north carry no gradient.

    Raises:
        TypeError: no numbers, or a system that is no text.
        ValueError: degrees out of their range, as when the two are exchanged, a system that pyproj does not know, that
            is not in metres, that counts to the west or south, or whose metres are none where the points are, by more
            than a twentieth.
        ModuleNotFoundError: pyproj is not installed.

    Example:
        >>> points, crs = metres_from_degrees([[40.4168, -3.7038], [40.4169, -3.7038]])
        >>> crs, [round(x, 2) for x in (points[1] - points[0]).tolist()]
        ('EPSG:32630', [0.09, 11.1])
    """
    degrees = _checked("degrees", degrees)
    latitude, longitude = degrees[..., 0], degrees[..., 1]
    wrong = ~((latitude.abs() <= 90) & (longitude.abs() <= 360))
    if bool(wrong.any()):
        raise ValueError(
            "degrees: want latitudes from -90 to 90, then longitudes from -360 to 360, got "
            f"{first_of(degrees, wrong)}; are they exchanged, or metres already?"
        )
    if crs is None:
        first = longitude.flatten()[:1]  # The middle is near the points on either side of the date line too.
        middle = (first + (longitude - first + 180) % 360 - 180).mean()
        crs = _utm(float(latitude.detach().mean()), float(middle.detach()))
    pyproj = _pyproj()
    system = _map(pyproj, crs)
    east, north = _transformed(pyproj, WGS84, system, latitude, longitude, swap=True)
    _check_lengths(pyproj, crs, system, latitude, longitude)
    return torch.stack([east, north, *degrees[..., 2:].unbind(-1)], dim=-1), crs


def degrees_from_metres(points: Float[Tensor, "*batch n d"] | Array, crs: str) -> Float[Tensor, "*batch n d"]:
    """Latitudes and longitudes of WGS 84 of points on a map: what `metres_from_degrees` undoes.

    Args:
        points: east, north, and, where there are three, heights, `(*B, N, 2)` or `(*B, N, 3)`.
        crs: the map's coordinate reference system, such as `"EPSG:32630"`.

    Raises:
        TypeError: no numbers, or a system that is no text.
        ValueError: a system that pyproj does not know, that is not in metres, that counts to the west or south, or that
            does not reach the points; or points that lie far off the map's area, as where east and north are exchanged.
        ModuleNotFoundError: pyproj is not installed.

    Example:
        >>> degrees = degrees_from_metres([[440291.53, 4474254.98, 650.0]], "EPSG:32630")
        >>> [round(x, 5) for x in degrees[0].tolist()]
        [40.41678, -3.70379, 650.0]
    """
    points = _checked("points", points)
    pyproj = _pyproj()
    system = _map(pyproj, crs)
    latitude, longitude = _transformed(pyproj, system, WGS84, points[..., 0], points[..., 1], swap=False)
    _check_place(pyproj, crs, system, points, latitude, longitude)
    return torch.stack([latitude, longitude, *points[..., 2:].unbind(-1)], dim=-1)


def _checked(name: str, value: Tensor | Array) -> Tensor:
    """Two or three float64 numbers a point."""
    found = check_tensor(name, value, "N", "2 or 3")
    if found.is_meta:
        raise ValueError(f"{name}: want values, got a tensor on the device meta")
    if found.numel() == 0:
        raise ValueError(f"{name}: want at least one point, got shape {tuple(found.shape)}")
    if found.shape[-1] not in (2, 3):
        raise ValueError(f"{name}: want shape (*B, N, 2) or (*B, N, 3), got {tuple(found.shape)}")
    if found.dtype != torch.float64:
        raise TypeError(
            f"{name}: want float64, got {found.dtype}, which rounds them by up to half a metre; read them so"
        )
    return found


def _pyproj() -> Any:
    try:
        import pyproj
        import pyproj.aoi
        import pyproj.database
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "pyproj: want it installed, to turn degrees into metres; pip install pyproj"
        ) from error
    return pyproj


def _transformed(
    pyproj: Any, source: Any, target: Any, first: Tensor, second: Tensor, swap: bool
) -> tuple[Tensor, Tensor]:
    """Two coordinates from one system to another, east before north, latitude before longitude."""
    try:
        transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise ValueError(
            f"crs: want a map that pyproj can work out, got {getattr(target, 'name', target)}: {error}"
        ) from error
    given = (second, first) if swap else (first, second)
    found = transformer.transform(*(part.detach().cpu().numpy() for part in given))
    x, y = (torch.as_tensor(part, dtype=first.dtype, device=first.device).reshape(first.shape) for part in found)
    if not bool((x.isfinite() & y.isfinite()).all()):
        other = target if source == WGS84 else source
        raise ValueError(
            f"crs: want a coordinate reference system that reaches the points, got {getattr(other, 'name', other)}"
        )
    return (x, y) if swap else (y, x)


def _map(pyproj: Any, name: str) -> Any:
    if not isinstance(name, str):
        raise TypeError(f"crs: want a coordinate reference system such as 'EPSG:32630', got {called(name)}")
    try:
        system = pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(f"crs: want a coordinate reference system such as 'EPSG:32630', got {name!r}") from error
    if not (system.is_projected and all(axis.unit_name == "metre" for axis in system.axis_info[:2])):
        raise ValueError(f"crs: want a map in metres, as UTM is, got {name!r} ({system.name})")
    ways = [axis.direction for axis in system.axis_info[:2]]
    if "west" in ways or ways.count("south") == 1:  # two souths, or two norths, are a pole's
        raise ValueError(
            f"crs: want a map that counts to the east and to the north, got {name!r} ({system.name}), which counts to "
            f"the {ways[0]} and to the {ways[1]}; take one like it that does, as 'EPSG:5514' is for 'EPSG:5513', or a "
            "UTM zone"
        )
    return system


def _check_lengths(pyproj: Any, name: str, system: Any, latitude: Tensor, longitude: Tensor) -> None:
    """Check that a metre on the map is about one on the ground, in every direction."""
    off = _stretch(pyproj, system, latitude, longitude)
    if len(off) == 0:
        return
    worst = off[off.abs().argmax()]
    if not float(worst.abs()) <= STRETCHED:
        raise ValueError(
            f"crs: want a map whose metres are those on the ground, got {name!r} ({system.name}), where a metre on "
            f"the ground is {1 + float(worst):.4g} at the points; leave crs out for the UTM zone of their middle, "
            "look whether the degrees are exchanged, or take points that lie closer together"
        )


def _check_place(pyproj: Any, name: str, system: Any, points: Tensor, latitude: Tensor, longitude: Tensor) -> None:
    """Check that points `(*B, N, d)` lie within a map's area, or not so far from it that its metres are none."""
    area = system.area_of_use
    if area is None:
        return
    low, high = points.new_tensor([area.west, area.south]), points.new_tensor([area.east, area.north])
    width = (high[0] - low[0]) % 360 or 360
    within = ((longitude - low[0]) % 360 <= width) & (latitude >= low[1]) & (latitude <= high[1])
    if bool(within.all()):  # lengths take three times as long as places
        return
    stretched = ~(_stretch(pyproj, system, latitude, longitude).abs() <= STRETCHED)
    wrong = ~within & stretched.to(within.device).reshape(2, *within.shape).any(0)
    if bool(wrong.any()):
        there = float(latitude[wrong][0]), float(longitude[wrong][0])
        raise ValueError(
            f"points: want east, then north, on the map {name!r} ({system.name}), got {first_of(points, wrong)}, which "
            "would be latitude {:.2f}, longitude {:.2f}, far off it; are they exchanged, or of another map?".format(
                *there
            )
        )


def _stretch(pyproj: Any, system: Any, latitude: Tensor, longitude: Tensor) -> Tensor:
    """By which part a map makes lengths longer where it does most, and then where it does least, `(2 n,)`."""
    flat = (part.detach().cpu().numpy().ravel() for part in (longitude, latitude))
    factors = pyproj.Proj(system).get_factors(*flat)
    scales = (factors.tissot_semimajor, factors.tissot_semiminor)
    return torch.cat([torch.as_tensor(scale, dtype=torch.float64, device="cpu").reshape(-1) - 1 for scale in scales])


def _utm(latitude: float, longitude: float) -> str:
    """The UTM zone of a place."""
    pyproj = _pyproj()
    longitude = (longitude + 180) % 360 - 180
    place = pyproj.aoi.AreaOfInterest(longitude, latitude, longitude, latitude)
    zones = pyproj.database.query_utm_crs_info(datum_name="WGS 84", area_of_interest=place)
    if not zones:
        polar = "EPSG:3413" if latitude > 0 else "EPSG:3031"
        raise ValueError(
            f"crs: want a coordinate reference system, such as {polar!r}, got none, and no UTM zone holds latitude "
            f"{latitude:g}, longitude {longitude:g}"
        )
    return f"EPSG:{zones[0].code}"
