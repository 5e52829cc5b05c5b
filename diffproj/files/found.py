"""`Found`: the cameras of a file by name, and how one asks for one of them."""

from dataclasses import dataclass, field

from diffproj.geometry.camera import Camera

MOST_NAMES = 8
"""Names of cameras in a message."""


class NotOneCameraError(ValueError):
    """A file holds the cameras of a fleet, and none of them is named."""


@dataclass(frozen=True)
class Found:
    """What a reader found in a file.

    Attributes:
        cameras: by name, in the file's order. One of them may be a batch, as the own JSON holds.
        aside: cameras that are to be asked for by name, such as the rectified one of a ROS file.
        unread: what in the file holds poses that were not read.
        remarks: what else is to be said of the file, in sentences.
    """

    cameras: dict[str, Camera]
    aside: dict[str, Camera] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def chosen(self, camera: str | int | None) -> Camera:
        """One camera, or a batch of all where they have one lens model and size.

        Args:
            camera: its name or its number, counted from 0; all of the file if left out.

        Raises:
            TypeError: neither name nor number.
            ValueError: there is no such camera, or several that no batch holds.
        """
        listed = ", ".join(list(self.cameras)[:MOST_NAMES]) + " and more" * (len(self.cameras) > MOST_NAMES)
        every = list(self.cameras.values())
        if camera is None:
            return every[0] if len(every) == 1 else self._batch(every, listed)
        if isinstance(camera, str):
            known = self.cameras | self.aside
            if camera not in known:
                aside = f", and aside {', '.join(self.aside)}" * bool(self.aside)
                raise ValueError(f"camera: want one of {listed}{aside}, got {camera!r}")
            return known[camera]
        if isinstance(camera, bool) or not isinstance(camera, int):
            raise TypeError(f"camera: want the name or the number of a camera, got {camera!r}")
        if len(every) == 1 and every[0].batch_shape:
            count = every[0].batch_shape[0]
            if not -count <= camera < count:
                raise ValueError(f"camera: want a number from 0 to {count - 1}, got {camera}")
            return every[0][camera]
        if not -len(every) <= camera < len(every):
            raise ValueError(f"camera: want a number from 0 to {len(every) - 1}, got {camera}")
        return every[camera]

    @staticmethod
    def _batch(cameras: list[Camera], listed: str) -> Camera:
        try:
            return Camera.stack(cameras)
        except (TypeError, ValueError):
            raise ValueError(
                f"camera: want the name of one camera, for the {len(cameras)} of the file differ in lens or size and "
                f"make no batch; they are {listed}"
            ) from None


def one_or_more(cameras: dict[str, Camera], nothing: str) -> Found:
    """What was found.

    Raises:
        ValueError: nothing was; the message says so in the words given.
    """
    if not cameras:
        raise ValueError(nothing)
    return Found(cameras)
