"""Views most of whose corners count little or nothing: those that are left are the few that happen to agree."""

from jaxtyping import Bool
from torch import Tensor

ANY_POSE = 3
"""Points that some pose always agrees with, wherever in the image they are."""
MOST_NAMED = 5
"""Views that are named."""


def mostly_left_out(counting: Bool[Tensor, "*b v n"], left_out: Bool[Tensor, "*b v n"]) -> Bool[Tensor, "*b v"]:
    """Of which views some corners count, but more are left out than agree beyond those three that any pose fits."""
    return counting.any(-1) & (left_out.sum(-1) + ANY_POSE > counting.sum(-1)) & left_out.any(-1)


def described(
    counting: Bool[Tensor, "*b v n"],
    left_out: Bool[Tensor, "*b v n"],
    names: tuple[str, ...],
    points: str = "corners",
    robust: bool = False,
) -> str:
    """What is to be said of these views, in a sentence; empty where there are none; `robust` says whether by a loss."""
    which = mostly_left_out(counting, left_out).nonzero().tolist()
    if not which:
        return ""
    lost, seen = left_out.sum(-1), (counting | left_out).sum(-1)
    listed = [
        f"{int(lost[(*camera, view)])} of {int(seen[(*camera, view)])} in {names[view]}"
        + (f" of camera {tuple(camera)}" if camera else "")
        for *camera, view in which[:MOST_NAMED]
    ]
    more = f", and too many in {len(which) - MOST_NAMED} more views" if len(which) > MOST_NAMED else ""
    how, remedy = ("hardly counted", ", or give the loss a larger scale") if robust else ("were left out", "")
    return (
        f"too many {points} {how} as outliers, {', '.join(listed)}{more}: the pose is that of the few that agree, "
        f"which may be by chance; look for blur, wrong {points} or another target, or leave the photograph out{remedy}"
    )
