"""Views most of whose corners were left out as outliers: those that are left are the few that happen to agree."""

from jaxtyping import Bool
from torch import Tensor

MOST_NAMED = 5
"""Views that are named."""


def mostly_left_out(used: Bool[Tensor, "*b v n"], rejected: Bool[Tensor, "*b v n"]) -> Bool[Tensor, "*b v"]:
    """Of which views some corners were used, but more of them left out."""
    return used.any(-1) & (rejected.sum(-1) > used.sum(-1))


def described(
    used: Bool[Tensor, "*b v n"], rejected: Bool[Tensor, "*b v n"], names: tuple[str, ...], points: str = "corners"
) -> str:
    """What is to be said of these views, in a sentence; empty where there are none."""
    which = mostly_left_out(used, rejected).nonzero().tolist()
    if not which:
        return ""
    lost, seen = rejected.sum(-1), (used | rejected).sum(-1)
    listed = [
        f"{int(lost[(*camera, view)])} of {int(seen[(*camera, view)])} in {names[view]}"
        + (f" of camera {tuple(camera)}" if camera else "")
        for *camera, view in which[:MOST_NAMED]
    ]
    more = f", and most in {len(which) - MOST_NAMED} more views" if len(which) > MOST_NAMED else ""
    return (
        f"most {points} were left out as outliers, {', '.join(listed)}{more}: the pose is that of the few that agree, "
        f"which may be by chance; look for blur, wrong {points} or another target, or leave the photograph out"
    )
