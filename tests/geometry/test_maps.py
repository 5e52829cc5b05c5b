"""North-up top views with their place on a map, and degrees to metres."""

import pytest
import torch

import diffproj as dp

D = torch.float64
EXTENT = (-30.0, -12.0, 25.0, 28.0)


@pytest.fixture
def above() -> dp.Camera:
    """40 m above the ground, x to the east, y to the north."""
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
    R = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=D)
    return dp.Camera(K, R, torch.tensor([0.0, 0, 40], dtype=D), size=(640, 480))


def test_north_up_is_the_other_view_upside_down_and_renders_back(above: dp.Camera) -> None:
    image = torch.rand(1, 480, 640, dtype=D)
    plane = dp.Plane.z(0.0)
    south_up, seen = dp.rectify(image, above, plane, EXTENT, 0.5)
    north_up, shown = dp.rectify(image, above, plane, EXTENT, 0.5, north_up=True)
    torch.testing.assert_close(north_up, south_up.flip(-2), rtol=0, atol=1e-12)
    assert torch.equal(shown, seen.flip(-2))
    texture = torch.rand(1, 80, 110, dtype=D)
    back, there = dp.render(texture, above, plane, EXTENT, north_up=True)
    want, too = dp.render(texture.flip(-2), above, plane, EXTENT)
    torch.testing.assert_close(back, want, rtol=0, atol=1e-12)
    assert torch.equal(there, too)


@pytest.mark.parametrize("resolution", [0.5, 0.7])  # a whole part of the extent, and not
def test_the_geotransform_places_each_pixel(above: dp.Camera, resolution: float) -> None:
    """A dot on the ground lies in the top view where the six numbers say."""
    origin = (642700.0, 8304290.0)
    east, north = 642700 + 11.3, 8304290 + 5.2
    pixel, _ = above.project(torch.tensor([[11.3, 5.2, 0]], dtype=D))
    u, v = (torch.arange(side, dtype=D) for side in (640, 480))
    dot = torch.exp(-((u - pixel[0, 0]) ** 2 + (v[:, None] - pixel[0, 1]) ** 2) / 50)
    top, _ = dp.rectify(dot[None], above, dp.Plane.z(0.0), EXTENT, resolution, north_up=True)
    x, dx, skew, y, turn, dy = dp.geotransform(EXTENT, resolution, origin)
    assert (skew, turn) == (0, 0)
    assert dy < 0 < dx
    rows, columns = top.shape[-2:]
    i, j = (torch.arange(side, dtype=D) + 0.5 for side in (rows, columns))
    weight = top[0] / top.sum()
    assert float(x + dx * (weight.sum(0) * j).sum()) == pytest.approx(east, abs=0.01)
    assert float(y + dy * (weight.sum(1) * i).sum()) == pytest.approx(north, abs=0.01)
    assert x + columns * dx == pytest.approx(642725)
    assert y + rows * dy == pytest.approx(8304278)


def test_geotransforms_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="extent: want"):
        dp.geotransform((0, 0, 0, 1), 0.5)
    with pytest.raises(ValueError, match="resolution: want"):
        dp.geotransform(EXTENT, 0)
    with pytest.raises((TypeError, ValueError), match="origin: want finite .east, north"):
        dp.geotransform(EXTENT, 1.0, (1, 2, 3))


def test_degrees_become_metres_and_back() -> None:
    pytest.importorskip("pyproj")
    degrees = torch.tensor([[[51.5007, -0.1246, 10], [51.5033, -0.1196, 20]]], dtype=D)  # Westminster, zone 30
    points, crs = dp.metres_from_degrees(degrees)
    assert crs == "EPSG:32630"
    torch.testing.assert_close(dp.degrees_from_metres(points, crs), degrees, rtol=0, atol=1e-9)
    # On the WGS 84 ellipsoid a degree is 111.26 km to the north and 69.5 km to the east here; UTM's scale here is 1.0003.
    east, north, up = (points[0, 1] - points[0, 0]).tolist()
    assert north == pytest.approx(0.0026 * 111_262, rel=0.05)  # the grid's north is turned by 2 degrees
    assert east == pytest.approx(0.0050 * 69_450, rel=0.05)
    assert (east**2 + north**2) ** 0.5 == pytest.approx(451.7, rel=1e-3)
    assert up == 10
    assert dp.metres_from_degrees([[-33.86, 151.21]])[1] == "EPSG:32756"  # Sydney: zone 56, south
    assert dp.metres_from_degrees([[-33.86, -208.79]])[1] == "EPSG:32756"
    fixed, crs = dp.metres_from_degrees([[40.0, -74.0]], "EPSG:32617")  # a neighbouring zone on demand
    assert crs == "EPSG:32617"
    assert float(fixed[0, 0]) > 900_000


@pytest.mark.parametrize(
    ("crs", "ways", "place"),
    [("EPSG:5513", "south and to the west", [50.0, 15.0]), ("EPSG:2048", "west and to the south", [-33.9, 18.4])],
)
def test_maps_that_count_to_the_west_or_the_south_are_refused(crs: str, ways: str, place: list[float]) -> None:
    """As east and north their numbers would be a mirrored or a turned world."""
    pytest.importorskip("pyproj")
    with pytest.raises(ValueError, match=f"crs: want a map that counts to the east and .* counts to the {ways}"):
        dp.metres_from_degrees([place], crs)
    with pytest.raises(ValueError, match="crs: want a map that counts to the east"):
        dp.degrees_from_metres([[1.0, 2.0]], crs)


def test_maps_that_name_north_first_or_lie_at_a_pole_are_taken() -> None:
    pytest.importorskip("pyproj")
    points, _ = dp.metres_from_degrees([[50.0, 9.0], [50.0, 9.001], [50.001, 9.0]], "EPSG:31467")  # north, east
    assert 70 < float(points[1, 0] - points[0, 0]) < 73
    assert 111 < float(points[2, 1] - points[0, 1]) < 112
    pole, _ = dp.metres_from_degrees([[85.0, 10.0], [85.0, 10.01], [85.001, 10.0]], "EPSG:3413")  # south, south
    east, north = pole[1] - pole[0], pole[2] - pole[0]
    assert float(east[0] * north[1] - east[1] * north[0]) > 0  # right-handed


def test_degrees_that_are_none_are_refused_by_name() -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(
        ValueError, match="degrees: want latitudes from -90 to 90.* are they exchanged, or metres already"
    ):
        dp.metres_from_degrees([[440291.53, 4474254.98]])
    with pytest.raises(ValueError, match="degrees: want latitudes"):
        dp.metres_from_degrees([[float("nan"), 0.0]])
    with pytest.raises(ValueError, match=r"degrees: want shape .*got \(1, 4\)"):
        dp.metres_from_degrees([[1.0, 2, 3, 4]])
    with pytest.raises(TypeError, match="degrees: want float64, got torch.float32, which rounds"):
        dp.metres_from_degrees(torch.tensor([[40.4, -3.7]]))
    with pytest.raises(ValueError, match="crs: want a coordinate reference system such as 'EPSG:32630', got 'mars'"):
        dp.metres_from_degrees([[40.4, -3.7]], "mars")
    with pytest.raises(ValueError, match="crs: want a map in metres, as UTM is, got 'EPSG:4269'"):
        dp.metres_from_degrees([[40.4, -3.7]], "EPSG:4269")
    with pytest.raises(ValueError, match="no UTM zone holds latitude 89"):
        dp.metres_from_degrees([[89.0, 0.0]])


def test_points_on_both_sides_of_the_date_line_are_neighbours() -> None:
    pytest.importorskip("pyproj")
    for degrees in ([[-18.0, 179.999], [-18.0, -179.999]], [[-18.0, -179.999], [-18.0, 179.999], [-18.0, 180.0]]):
        points, crs = dp.metres_from_degrees(degrees)
        assert crs in ("EPSG:32701", "EPSG:32760")
        # A degree of the parallel is 105.9 km there, and UTM stretches it by 1.0010 at a zone's edge.
        assert float((points[1] - points[0])[:2].norm()) == pytest.approx(0.002 * 105_905 * 1.001, rel=1e-3)


@pytest.mark.parametrize(
    ("degrees", "crs"),
    [
        ([[45.0, 3.0]], "EPSG:3857"),  # Web Mercator: 1.41 of a metre
        ([[40.0, -75.0]], "EPSG:32633"),  # a zone of another continent
        ([[5.0, 5.0], [5.0, 60.0]], None),
        ([[40.0, 3.0]], "EPSG:4326"),  # degrees
    ],
)
def test_a_map_whose_metres_are_none_is_refused(degrees: list[list[float]], crs: str | None) -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(ValueError, match="crs: want a map (in|whose) metres.*, got .EPSG"):
        dp.metres_from_degrees(degrees, crs)
    for system in ("EPSG:2154", "EPSG:3035"):  # national and European grids
        dp.metres_from_degrees([[45.0, 3.0]], system)


def test_east_and_north_exchanged_are_refused_on_the_way_back() -> None:
    """Madrid's would lie in Kenya."""
    pytest.importorskip("pyproj")
    points, crs = dp.metres_from_degrees([[40.4168, -3.7038], [40.4170, -3.7036]])
    with pytest.raises(ValueError, match=r"points: want east, then north, .*latitude 3.31.*are they exchanged"):
        dp.degrees_from_metres(points.flip(-1), crs)
    for place, system in (  # a neighbouring zone, zones that touch the date line, a pole, and a world map
        ([40.0, -74.0], "EPSG:32617"),
        ([-18.0, -179.9], "EPSG:32760"),
        ([65.0, 179.9], "EPSG:32601"),
        ([-80.0, 170.0], "EPSG:3031"),
    ):
        there, _ = dp.metres_from_degrees([place], system)
        torch.testing.assert_close(
            dp.degrees_from_metres(there, system), torch.tensor([place], dtype=D), rtol=0, atol=1e-7
        )
    assert dp.degrees_from_metres([[0.0, 8399737.9]], "EPSG:3857").tolist()[0] == pytest.approx([60, 0], abs=1e-6)


def test_within_a_maps_area_the_way_back_asks_for_no_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    """They took three times as long as the places themselves."""
    pyproj = pytest.importorskip("pyproj")
    monkeypatch.setattr(pyproj, "Proj", lambda *_: pytest.fail("lengths"))
    found = dp.degrees_from_metres([[440291.53, 4474254.98], [440300.0, 4474300.0]], "EPSG:32630")
    assert found[0].tolist() == pytest.approx([40.41678, -3.70379], abs=1e-5)


def test_a_map_that_is_none_is_refused_and_a_gradient_is_no_warning() -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(ValueError, match="crs: want a map that pyproj can work out, got WGS 84 / UTM grid system"):
        dp.metres_from_degrees([[40.4, -3.7]], "EPSG:32600")
    points, _ = dp.metres_from_degrees(torch.tensor([[40.4, -3.7]], dtype=D, requires_grad=True))
    assert not points.requires_grad


@pytest.mark.plain
def test_without_pyproj_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install pyproj"):
        dp.metres_from_degrees([[40.4, -3.7]])
    monkeypatch.undo()
    with pytest.raises(TypeError, match="crs: want a coordinate reference system such as"):
        dp.metres_from_degrees([[40.4, -3.7]], 32630)
